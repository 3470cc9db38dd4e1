import pytest
import torch

from stereokit.bench import budget as module
from stereokit.bench.budget import Budget, measure_budget


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LARGEST", 512)
    monkeypatch.setattr(module, "COPY_BYTES", 1 << 12)


@pytest.mark.usefixtures("_small")
def test_the_fastest_run_counts() -> None:
    readings = 0
    now = 0.0

    def clock() -> float:
        """Each run takes 0.25 s, but every third half of that."""
        nonlocal readings, now
        readings += 1
        if readings % 2 == 0:
            now += 0.125 if readings % 6 == 0 else 0.25
        return now

    found = measure_budget("cpu", ["float32"], clock=clock)
    assert found.flops["float32"] == 2 * 256**3 / 0.125
    assert found.copy_bytes == 2 * (1 << 12) / 0.125
    assert found.device == "cpu"


@pytest.mark.usefixtures("_small")
def test_matrices_grow_until_a_product_takes_long_enough() -> None:
    found = measure_budget("cpu", ["float32"], clock=iter([float(i) * 0.01 for i in range(100)]).__next__)
    assert found.flops["float32"] == pytest.approx(2 * 512**3 / 0.01)


@pytest.mark.usefixtures("_small")
def test_precisions_without_a_product_are_left_out_and_settings_stay() -> None:
    before = torch.get_float32_matmul_precision()
    found = measure_budget("cpu", ["int8", "bfloat16"])
    assert set(found.flops) == {"bfloat16"}
    assert torch.get_float32_matmul_precision() == before


def test_the_share_of_the_limit() -> None:
    limits = Budget("cpu", {"float32": 160e9}, 10e9)
    assert limits.share(32_650_000_000, 0.67, "float32") == pytest.approx(65.3 / 0.67 / 160)
    assert limits.share(1, 1, "int8") is None
