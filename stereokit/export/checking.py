"""An exported file against the network that it came from."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from stereokit.backends.estimate import Backend, Estimate
from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError, InputError
from stereokit.export.graph import example_size
from stereokit.export.ties import tied_pixels

__all__ = ["Difference", "Pair", "check_exact", "check_pairs", "check_size", "compare", "random_pair"]

Pair = tuple[Tensor, Tensor]

TOLERANCE = 0.01
"""In pixels: kernels that add in another order are nearer than that."""

OUTLIERS = 0.002
"""Share of pixels that may be further away beside those where candidates tie: some steps make rounding larger."""


TIES = 0.05
"""Share of pixels that ties may explain at most: where more candidates tie, the disparity proves nothing."""


@dataclass(frozen=True)
class Difference:
    """Between the disparities of an exported file and of its network in float32, over the pixels of one pair.

    Args:
        pair: what the pair is.
        size: its height and width.
        mean: of the absolute difference, in pixels.
        highest: of it.
        above_tolerance: share of pixels further than 0.01 px apart.
        tied: share of pixels that are so where two candidates tie, of which the top k may keep either.
        above_1px: share of pixels further than 1 px apart.
        confidence: mean absolute difference of the confidence; None if there is none.
    """

    pair: str
    size: tuple[int, int]
    mean: float
    highest: float
    above_tolerance: float
    tied: float
    above_1px: float
    confidence: float | None

    def __str__(self) -> str:
        height, width = self.size
        tied = f" ({100 * self.tied:.3g} % where candidates tie)" if self.tied else ""
        return (
            f"{self.pair}, {width} x {height} px: disparity differs by {self.mean:.2g} px on average, by more than "
            f"{TOLERANCE} px at {100 * self.above_tolerance:.3g} %{tied} and 1 px at {100 * self.above_1px:.3g} % of "
            "pixels"
        )


def random_pair(height: int, width: int, seed: int = 0) -> Pair:
    """A texture of all scales, and the same 4 px to the left: two (1, 3, H, W), float32 in [0, 1].

    >>> left, right = random_pair(40, 50)
    >>> torch.equal(left[..., 4:], right[..., :-4])
    True
    """
    generator = torch.Generator().manual_seed(seed)
    texture = torch.zeros(1, 3, height, width + 4)
    for cells in (4, 16, 64):
        noise = torch.rand(1, 3, cells, cells, generator=generator)
        texture += nn.functional.interpolate(noise, (height, width + 4), mode="bilinear") / 3
    return texture[..., :-4].contiguous(), texture[..., 4:].contiguous()


def check_pairs(model: nn.Module, size: tuple[int, int] | None) -> list[tuple[str, Pair]]:
    """Pairs that a file can be checked on: of its own size, or of one that needs no padding and of an odd one."""
    if size is not None:
        return [("random texture", random_pair(*size))]
    height, width = example_size(model)
    multiple = int(getattr(model, "multiple", 1))
    fitting = ((height - 1) // multiple * multiple, (width + multiple) // multiple * multiple)
    return [("random texture", random_pair(*pair)) for pair in (fitting, (height, width - multiple - 2))]


def check_size(pairs: Iterable[Pair], size: tuple[int, int] | None, what: str) -> None:
    """Raises `InputError` where pairs are of another size than the one that a file is for.

    Args:
        pairs: images (1, 3, H, W).
        size: height and width; None for any.
        what: the pairs are, for the message.
    """
    for left, _ in pairs:
        given = (left.shape[-2], left.shape[-1])
        if size is not None and given != size:
            raise InputError(
                f"a pair {what} is {given[1]} x {given[0]} pixels, but the export is for {size[1]} x {size[0]}; leave "
                "out the size, or give pairs of it"
            )


def compare(backend: Backend, model: nn.Module, pairs: Iterable[tuple[str, Pair]]) -> list[Difference]:
    """Runs both on pairs.

    Args:
        backend: with the exported file.
        model: on the CPU.
        pairs: names and images, (1, 3, H, W).

    Raises:
        ConfigError: the file gives values that are not finite.
    """
    model.eval()
    differences = []
    for name, (left, right) in pairs:
        with torch.inference_mode():
            output: StereoOutput = model(left, right)
        expected, given = Estimate.of(output), backend(left, right)
        apart = np.abs(given.disparity - expected.disparity)
        if not all(np.isfinite(values).all() for values in given if values is not None):
            raise ConfigError(f"the exported network is wrong: {name} gives values that are not finite")
        far = apart > TOLERANCE
        tied = far & tied_pixels(model, left, right).numpy() if far.any() else far
        confidence = None
        if given.confidence is not None and expected.confidence is not None:
            confidence = float(np.abs(given.confidence - expected.confidence).mean())
        differences.append(
            Difference(
                pair=name,
                size=(left.shape[-2], left.shape[-1]),
                mean=float(apart.mean()),
                highest=float(apart.max()),
                above_tolerance=float(far.mean()),
                tied=float(tied.mean()),
                above_1px=float((apart > 1).mean()),
                confidence=confidence,
            )
        )
    return differences


def check_exact(differences: Sequence[Difference]) -> None:
    """Raises `ConfigError` unless a float32 file agrees with its network, ties of the top k aside."""
    for difference in differences:
        unexplained = difference.above_tolerance - min(difference.tied, TIES)
        if unexplained > OUTLIERS or (difference.confidence or 0) > TOLERANCE:
            raise ConfigError(
                f"the exported network is wrong and was not kept: {difference}; at most {100 * OUTLIERS:g} % of "
                "pixels may differ, ties aside"
            )
