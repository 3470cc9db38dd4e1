"""Pairs matched at another resolution."""

from collections.abc import Callable
from typing import TypeAlias

from torch import Tensor
from torch.nn import functional as F

from stereokit.contracts import StereoOutput
from stereokit.errors import InputError
from stereokit.layers.casting import as_float
from stereokit.network import MIN_SIZE

__all__ = ["Run", "match_scaled", "scaled_size"]

Run: TypeAlias = Callable[[Tensor, Tensor], StereoOutput]
"""Left and right images (B, 3, H, W) to a `StereoOutput`: a network, or what calls one."""


MAX_SCALE = 8
"""Of a pair: enlarging adds nothing to it, and a network only finds what is finer than its own grid."""


def match_scaled(run: Run, left: Tensor, right: Tensor, *, scale: float) -> StereoOutput:
    """Matches a pair at another resolution and brings the result back to the given one.

    The disparity is divided by what the width was multiplied by; so is the largest one that can be found, and the
    smallest detail that can be seen: below 1 larger disparities and less detail, above 1 finer detail, in more time and
    memory.

    Args:
        run: matches the scaled pair; a network, or what calls one.
        left: (B, 3, H, W), uint8, or floating-point in [0, 1].
        right: likewise.
        scale: size of the scaled pair, in parts of the given one, above 0 and at most 8.

    Returns:
        Disparity and confidence at the resolution of `left`, on its device.

    Raises:
        InputError: a scale that is out of range, or a scaled pair that is too small.

    >>> import torch
    >>> from stereokit import StereoOutput
    >>> def constant(left, right):
    ...     return StereoOutput(torch.full((1, *left.shape[-2:]), 5.0))
    >>> left = right = torch.rand(1, 3, 80, 120)
    >>> match_scaled(constant, left, right, scale=0.5).disparity.unique()
    tensor([10.])
    """
    height, width = left.shape[-2:]
    scaled = scaled_size((height, width), scale)
    output = run(scale_images(left, scaled), scale_images(right, scaled))
    factor = width / scaled[1]
    confidence = None if output.confidence is None else _sample(output.confidence, (height, width)).to(left.device)
    return StereoOutput((_sample(output.disparity, (height, width)) * factor).to(left.device), confidence=confidence)


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Height and width of a pair that `match_scaled` matches.

    Raises:
        InputError: a scale that is out of range, or a scaled pair that is too small.

    >>> scaled_size((480, 640), 0.25)
    (120, 160)
    """
    if not 0 < scale <= MAX_SCALE:
        raise InputError(f"scale {scale:g} is not above 0 and at most {MAX_SCALE}")
    height, width = (max(1, round(side * scale)) for side in size)
    if min(height, width) < min(MIN_SIZE, *size):
        raise InputError(
            f"scale {scale:g} makes {height} x {width} pixels of {size[0]} x {size[1]}; "
            f"use at least {min(1.0, MIN_SIZE / min(size)):.3g}"
        )
    return height, width


def scale_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Images (B, 3, H, W) at another height and width; uint8 becomes float32 in [0, 1]."""
    # area means, of windows that are not equally wide, would shift pixels to and fro by up to half a pixel
    scaled = F.interpolate(as_float(images).float(), size, mode="bilinear", align_corners=False, antialias=True)
    return scaled.to(images.dtype) if images.is_floating_point() else scaled


def _sample(values: Tensor, size: tuple[int, int]) -> Tensor:
    # with antialias a map that shrinks would have broader edges, of disparities that no surface has
    return F.interpolate(values[:, None].float(), size, mode="bilinear", align_corners=False)[:, 0]
