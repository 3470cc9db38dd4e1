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


def valid_pixels(truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None) -> Tensor:
    """Where ground truth counts: 0 < d* < max_disparity, finite, and within the mask.

    Args:
        truth: d*, any shape, in pixels.
        mask: bool, of the truth's shape; pixels to leave out are False.
        max_disparity: ceiling, exclusive, in pixels. None counts every known pixel.

    Returns:
        bool, of the truth's shape.

    Raises:
        InputError: a mask of another shape or type, or a ceiling that leaves nothing.

    >>> truth = torch.tensor([0.0, 5.0, 200.0, float("nan"), float("inf")])
    >>> valid_pixels(truth, max_disparity=192).tolist()
    [False, True, False, False, False]
    """
    valid = torch.isfinite(truth) & (truth > 0)
    if max_disparity is not None:
        valid &= truth < checked_ceiling(max_disparity)
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
        negative: below 0.
        too_large: at or above the ceiling.
    """

    valid: int = 0
    not_finite: int = 0
    zero: int = 0
    negative: int = 0
    too_large: int = 0

    @property
    def total(self) -> int:
        """All pixels."""
        return sum(astuple(self))

    @property
    def known(self) -> int:
        """Pixels that have a value, whether it counts or not."""
        return self.valid + self.negative + self.too_large

    def __add__(self, other: "PixelCounts") -> "PixelCounts":
        return PixelCounts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def count_pixels(truth: Tensor | npt.NDArray[Any], *, max_disparity: float | None = None) -> PixelCounts:
    """Counts the pixels of ground truth by the rule of `valid_pixels` that each falls under.

    Args:
        truth: d*, any shape, in pixels.
        max_disparity: ceiling, exclusive, in pixels. None counts every known pixel.

    Raises:
        InputError: a ceiling that leaves nothing.

    >>> count_pixels(torch.tensor([0.0, 5.0, -5.0, 200.0, float("nan")]), max_disparity=192)
    PixelCounts(valid=1, not_finite=1, zero=1, negative=1, too_large=1)
    """
    truth = torch.as_tensor(truth)
    valid = int(valid_pixels(truth, max_disparity=max_disparity).sum())
    not_finite = truth.numel() - int(torch.isfinite(truth).sum())
    zero = int((truth == 0).sum())
    negative = int((torch.isfinite(truth) & (truth < 0)).sum())
    return PixelCounts(valid, not_finite, zero, negative, truth.numel() - valid - not_finite - zero - negative)


def absolute_error(
    prediction: Tensor, truth: Tensor, mask: Tensor | None, max_disparity: float | None
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
    valid = valid_pixels(truth, mask, max_disparity=max_disparity)
    prediction, truth = prediction.detach().to(dtype), truth.to(dtype)
    error = (prediction - truth).abs().masked_fill(~torch.isfinite(prediction), math.inf)
    return error.masked_fill(~valid, 0), truth, valid


def is_outlier(error: Tensor, truth: Tensor) -> Tensor:
    """KITTI 2015's outlier: more than 3 px and more than 5 % of the truth."""
    return (error > D1_ABSOLUTE) & (error / truth > D1_RELATIVE)


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


def checked_ceiling(max_disparity: float) -> float:
    if not 0 < max_disparity < math.inf:
        raise InputError(f"max_disparity is {max_disparity}; expected pixels above 0, or None for no ceiling")
    return float(max_disparity)
