"""Which pixels count, and how far each is off."""

import math
from dataclasses import astuple, dataclass
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from stereokit.errors import InputError

__all__ = ["PixelCounts", "count_pixels", "valid_pixels"]

D1_ABSOLUTE, D1_RELATIVE = 3.0, 0.05


def valid_pixels(
    truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None, min_disparity: float = 0
) -> Tensor:
    """Where ground truth counts: 0 < d* < max_disparity, finite, and within the mask.

    With another `min_disparity` than 0 it is min_disparity <= d* < max_disparity. Below 0 this makes 0 a disparity like
    any other: what is unknown must be NaN, or lie below.

    Args:
        truth: d*, any shape, in pixels.
        mask: bool, of the truth's shape; pixels to leave out are False.
        max_disparity: ceiling, exclusive, in pixels. None counts every known pixel.
        min_disparity: floor, in pixels.

    Returns:
        bool, of the truth's shape.

    Raises:
        InputError: a mask of another shape or type, or a floor and a ceiling that leave nothing.

    >>> truth = torch.tensor([0.0, 5.0, 200.0, float("nan"), float("inf")])
    >>> valid_pixels(truth, max_disparity=192).tolist()
    [False, True, False, False, False]
    >>> valid_pixels(truth, min_disparity=-16).tolist()
    [True, True, True, False, False]
    """
    floor = checked_floor(min_disparity)
    valid = torch.isfinite(truth) & (truth >= floor if floor else truth > 0)
    if max_disparity is not None:
        valid &= truth < checked_ceiling(max_disparity, floor)
    if mask is not None:
        valid &= checked_mask(mask, "mask", truth)
    return valid


@dataclass(frozen=True)
class PixelCounts:
    """How many pixels of ground truth count by `valid_pixels`, and which rule leaves out the others.

    Attributes:
        valid: that count.
        not_finite: NaN or infinite, which means unknown.
        zero: 0, which means unknown too.
        negative: below 0, and below the floor.
        too_large: at or above the ceiling.
        too_small: above 0, and below the floor.
    """

    valid: int = 0
    not_finite: int = 0
    zero: int = 0
    negative: int = 0
    too_large: int = 0
    too_small: int = 0

    @property
    def total(self) -> int:
        """All pixels."""
        return sum(astuple(self))

    @property
    def known(self) -> int:
        """Pixels that have a value, whether it counts or not."""
        return self.valid + self.negative + self.too_large + self.too_small

    def __add__(self, other: "PixelCounts") -> "PixelCounts":
        return PixelCounts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def dropped(self) -> dict[str, int]:
        """Pixels that have a value and do not count, by the rule that leaves them out; rules without any are left out.

        >>> PixelCounts(valid=5, negative=3).dropped()
        {'below 0': 3}
        """
        rules = {"below 0": self.negative, "below the floor": self.too_small, "at or above the ceiling": self.too_large}
        return {rule: number for rule, number in rules.items() if number}


def count_pixels(
    truth: Tensor | npt.NDArray[Any], *, max_disparity: float | None = None, min_disparity: float = 0
) -> PixelCounts:
    """Counts the pixels of ground truth by the rule of `valid_pixels` that each falls under.

    Args:
        truth: d*, any shape, in pixels.
        max_disparity: ceiling, exclusive, in pixels. None counts every known pixel.
        min_disparity: floor, in pixels, see `valid_pixels`.

    Raises:
        InputError: a floor and a ceiling that leave nothing.

    >>> count_pixels(torch.tensor([0.0, 5.0, -5.0, 200.0, float("nan")]), max_disparity=192)
    PixelCounts(valid=1, not_finite=1, zero=1, negative=1, too_large=1, too_small=0)
    """
    truth = torch.as_tensor(truth)
    valid = valid_pixels(truth, max_disparity=max_disparity, min_disparity=min_disparity)
    rest = truth[~valid]
    left_out = rest[torch.isfinite(rest)]
    too_large = left_out >= (math.inf if max_disparity is None else max_disparity)
    return PixelCounts(
        valid=int(valid.sum()),
        not_finite=rest.numel() - left_out.numel(),
        zero=int(((left_out == 0) & ~too_large).sum()),
        negative=int(((left_out < 0) & ~too_large).sum()),
        too_large=int(too_large.sum()),
        too_small=int(((left_out > 0) & ~too_large).sum()),
    )


def absolute_error(
    prediction: Tensor, truth: Tensor, mask: Tensor | None, max_disparity: float | None, min_disparity: float = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """|d - d*|, infinite without a prediction; d* in the same type; which pixels count. On one device."""
    for name, tensor in (("prediction", prediction), ("truth", truth)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} is {kind}; expected disparity in pixels, a floating-point torch.Tensor")
    if prediction.shape != truth.shape:
        raise InputError(
            f"prediction has shape {tuple(prediction.shape)} and truth {tuple(truth.shape)}; expected the same for both"
        )
    # In float64 the difference of two float32 numbers is exact, so that an error of exactly 3 px is not
    # "above 3". Apple's GPUs have no float64.
    dtype = torch.float32 if prediction.device.type == "mps" else torch.float64
    truth = truth.detach().to(prediction.device)
    valid = valid_pixels(truth, mask, max_disparity=max_disparity, min_disparity=min_disparity)
    prediction, truth = prediction.detach().to(dtype), truth.to(dtype)
    error = (prediction - truth).abs().masked_fill(~torch.isfinite(prediction), math.inf)
    return error.masked_fill(~valid, 0), truth, valid


def is_outlier(error: Tensor, truth: Tensor) -> Tensor:
    """KITTI 2015's outlier: more than 3 px and more than 5 % of the truth."""
    return (error > D1_ABSOLUTE) & (error / truth.abs() > D1_RELATIVE)


def checked_mask(mask: Tensor, name: str, truth: Tensor) -> Tensor:
    if mask.dtype != torch.bool or mask.shape != truth.shape:
        raise InputError(
            f"{name} is {mask.dtype} of shape {tuple(mask.shape)}; expected torch.bool of the truth's shape, "
            f"{tuple(truth.shape)}"
        )
    return mask.to(truth.device)


def checked_tau(tau: float) -> float:
    if not 0 <= tau < math.inf:
        raise InputError(f"tau is {tau}; expected a threshold in pixels, 0 or larger")
    return float(tau)


def checked_floor(min_disparity: float) -> float:
    if not -math.inf < min_disparity < math.inf:
        raise InputError(f"min_disparity is {min_disparity}; expected a number of pixels, 0 by default")
    return float(min_disparity)


def checked_ceiling(max_disparity: float, floor: float = 0) -> float:
    if not floor < max_disparity < math.inf:
        raise InputError(f"max_disparity is {max_disparity}; expected pixels above {floor:g}, or None for no ceiling")
    return float(max_disparity)
