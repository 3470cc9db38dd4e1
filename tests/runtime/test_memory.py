import logging
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from stereokit import ConfigError, StereoOutput, build_model
from stereokit.runtime.memory import available_memory, estimate_memory, format_memory, parse_memory
from stereokit.runtime.memory.available import _container_available, _linux_available
from stereokit.runtime.memory.estimate import HELD_BY_ALLOCATOR
from stereokit.runtime.memory.peak import PeakMemory


class Doubling(nn.Module):
    """Makes float32 maps of known sizes: at most the pair and two maps of its size are alive."""

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        x = left.float() + 1
        y = x + 1
        del x
        z = y.mul(2)
        return StereoOutput(z[:, 0])


def test_live_tensors_are_counted_and_dead_ones_are_not() -> None:
    images = 2 * 3 * 40 * 50
    one = 3 * 40 * 50 * 4
    assert estimate_memory(Doubling(), 40, 50) == int((images + 2 * one) * HELD_BY_ALLOCATOR)
    floats = estimate_memory(Doubling(), 40, 50, dtype=torch.float32)
    # .float() of a float makes no copy
    assert floats == int((4 * images + 2 * one) * HELD_BY_ALLOCATOR)
    assert estimate_memory(Doubling(), 40, 50, batch=3) == pytest.approx(3 * estimate_memory(Doubling(), 40, 50), abs=2)


class Refusing(nn.Module):
    """PyTorch has no mean of whole numbers."""

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        return StereoOutput((left - right).mean(1))


def test_a_network_that_fails_is_one_error_and_no_traceback() -> None:
    log, printed = logging.getLogger("torch._subclasses.fake_tensor"), []
    handler = logging.Handler()
    handler.emit = printed.append  # type: ignore[method-assign,assignment]
    log.addHandler(handler)
    try:
        with pytest.raises(ConfigError, match="memory that Refusing needs can't be found out without running it: mean"):
            estimate_memory(Refusing(), 40, 50)
    finally:
        log.removeHandler(handler)
    assert printed == []
    assert not log.disabled


@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet"])
def test_every_network_can_be_estimated_and_stays_as_it_was(name: str) -> None:
    model = build_model(name, max_disparity=64).eval()
    before = {key: value.clone() for key, value in model.state_dict().items()}
    # large enough that copies of weights do not matter
    small, large = (estimate_memory(model, 256, width) for width in (256, 1024))
    assert 2.5 * small < large < 6 * small
    assert all(torch.equal(before[key], value) for key, value in model.state_dict().items())
    assert type(next(model.parameters())) is nn.Parameter


def test_the_estimate_does_not_hang_on_the_mode() -> None:
    model = build_model("coex", max_disparity=64).eval()
    expected = estimate_memory(model, 128, 256)
    with torch.inference_mode():
        assert estimate_memory(model, 128, 256) == expected
        assert estimate_memory(build_model("coex", max_disparity=64).eval(), 128, 256) == expected


def test_other_threads_may_run_the_network_while_it_is_estimated() -> None:
    seen = []

    class Watching(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.convolution = nn.Conv2d(3, 1, 3, padding=1)

        def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
            seen.append((type(self.convolution.weight), type(network.convolution.weight)))
            return StereoOutput(self.convolution(left.float())[:, 0])

    network = Watching()
    estimate_memory(network, 40, 50)
    [(estimated, own)] = seen
    assert estimated is not nn.Parameter
    assert own is nn.Parameter


def test_a_network_that_reads_values_is_refused() -> None:
    class Curious(nn.Module):
        def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
            return StereoOutput(left[:, 0] if float(left.sum()) > 0 else right[:, 0])

    with pytest.raises(ConfigError, match="memory that Curious needs can't be found out"):
        estimate_memory(Curious(), 40, 50)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "height", "width"), [("coex", 384, 1248), ("psmnet", 256, 512), ("gcnet", 128, 256)])
def test_estimates_are_near_the_measured_peak(name: str, height: int, width: int) -> None:
    if (peak := PeakMemory("cpu")).bytes() is None:
        pytest.skip("this system does not tell a process its peak memory")
    model = build_model(name).eval()
    left, right = torch.randint(0, 256, (2, 1, 3, height, width), dtype=torch.uint8)
    with torch.inference_mode():
        model(left, right)
        peak = PeakMemory("cpu")
        model(left, right)
        measured = peak.bytes()
    assert measured is not None
    assert 1 / 1.5 < measured / estimate_memory(model, height, width) < 1.5


def test_free_memory_is_read_from_the_system(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemTotal:       99 kB\nMemAvailable:       20 kB\n")
    assert _linux_available(tmp_path / "meminfo") == 20 * 1024
    assert _linux_available(tmp_path / "none") is None
    assert _container_available(tmp_path) is None
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("300\n")
    (tmp_path / "memory.stat").write_text("anon 100\ninactive_file 150\nactive_file 50\n")
    # pages of files that are not in use are dropped when memory is needed
    assert _container_available(tmp_path) == 850
    (tmp_path / "memory.max").write_text("max\n")
    assert _container_available(tmp_path) is None
    if sys.platform == "linux":
        assert 2**20 < available_memory() < 2**50


def test_amounts_of_memory() -> None:
    assert parse_memory("1.5 g") == 1_500_000_000
    assert parse_memory("2KiB") == 2048
    assert parse_memory(" 7 ") == parse_memory("7B") == 7
    assert format_memory(1.5 * 2**40) == "1536.0 GiB"
    for wrong in ("4 apples", "", "-1GB", "0", 0, -5, True, None, 1.5):
        with pytest.raises(ConfigError, match="'4GiB'"):
            parse_memory(wrong)  # type: ignore[arg-type]
