"""What every registered network is held to: an entry each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

__all__ = ["CASES", "Case", "Golden", "Tap"]

ALL_EXPORTS = ("onnx", "openvino", "program")


@dataclass(frozen=True)
class Tap:
    """What a recording holds of the inside of a network.

    Args:
        module: whose output it is.
        steps: of the last axes that were kept, such as "6/4/4".
        item: of an output that is a tuple, or the key of one that is a mapping.
        field: of a named tuple.
        left: the left half of a batch of both views.
        sign: -1 where lower is better there.
    """

    module: str
    steps: str = ""
    item: int | None = None
    field: str | None = None
    left: bool = False
    sign: int = 1

    def read(self, output: Any) -> Tensor:
        """The recorded part of a module's output."""
        if self.field is not None:
            output = getattr(output, self.field)
        if self.item is not None:
            output = output[self.item]
        if self.left:
            output = output.chunk(2)[0]
        steps = [int(step) for step in self.steps.split("/") if step]
        return self.sign * output[(..., *(slice(None, None, step) for step in steps))]


@dataclass(frozen=True)
class Golden:
    """A recording of the published network.

    Args:
        name: of the recording.
        norm: range of the norms' weights.
        taps: by the name of the array.
        seed: of the weights.
        overrides: of `load_published`.
        logits: largest difference of the taps, in parts of their spread.
        pixels: share of pixels whose disparity is within 0.01 px.
    """

    name: str
    norm: tuple[float, float]
    taps: Mapping[str, Tap] = field(default_factory=dict)
    seed: int = 1
    overrides: Mapping[str, Any] = field(default_factory=dict)
    logits: float = 1e-4
    pixels: float = 1.0


@dataclass(frozen=True)
class Case:
    """What is known of a network.

    Args:
        parameters: learned numbers.
        golden: its recording, or why there is none.
        training_only: parameters that are used in training alone.
        loss: of its paper.
        exports: the formats that it can be written in.
        no_export: why not the others.
        max_disparity: that the quick tests run at.
        size: that the quick tests run at, height and width; multiples of what the network pads to.
        seam: the mean difference in px that tiles make, at most, with random weights.
        gradients_missing: weights that no gradient reaches, for a reason that stands beside.
    """

    parameters: int
    golden: Golden | str
    training_only: int = 0
    loss: str | Mapping[str, Any] = "smooth_l1"
    exports: tuple[str, ...] = ALL_EXPORTS
    no_export: str = ""
    max_disparity: int = 64
    size: tuple[int, int] = (64, 96)
    seam: float = 3.0
    gradients_missing: tuple[str, ...] = ()


def _lightstereo(size: str, parameters: int) -> Case:
    taps = {"volume": Tap("cost", "2/2"), "aggregated": Tap("aggregation", item=-1)}
    return Case(parameters=parameters, golden=Golden(f"lightstereo_{size}", norm=(0.5, 0.75), taps=taps))


ELSEWHERE = "held to its recordings in tests/weights/test_published.py"

CASES: dict[str, Case] = {
    "coex": Case(parameters=2_721_993, golden=ELSEWHERE),
    "psmnet": Case(parameters=5_224_768, golden=ELSEWHERE),
    "gcnet": Case(parameters=2_845_376, golden="no weights were published"),
    "lightstereo_s": _lightstereo("s", 3_441_360),
    "lightstereo_m": _lightstereo("m", 7_641_264),
    "lightstereo_l": _lightstereo("l", 24_286_512),
}


def captured(model: nn.Module, taps: Mapping[str, Tap], run: Any) -> dict[str, Tensor]:
    """What the taps read in one pass; of a module that is called several times, the first."""
    found: dict[str, Tensor] = {}
    handles = []
    for name, tap in taps.items():

        def keep(_module: nn.Module, _inputs: Any, output: Any, name: str = name, tap: Tap = tap) -> None:
            found.setdefault(name, tap.read(output))

        handles.append(model.get_submodule(tap.module).register_forward_hook(keep))
    try:
        run()
    finally:
        for handle in handles:
            handle.remove()
    return found
