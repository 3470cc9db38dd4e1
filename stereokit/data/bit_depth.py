"""How many bits of a stored sample are used, and so which sample is white."""

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError

__all__ = ["check_bit_depth", "to_rgb", "warn_of_other_depths"]

_DARK_BITS = 14
# fewer samples say nothing of the camera
_ENOUGH = 1000


def check_bit_depth(bit_depth: int | None) -> None:
    """Refuses what is no number of bits.

    Raises:
        InputError: it is not a whole number from 1 to 16.
    """
    if bit_depth is not None and not (type(bit_depth) is int and 1 <= bit_depth <= 16):
        raise InputError(f"bit_depth must be a whole number from 1 to 16, got {bit_depth!r}")


def to_rgb(
    samples: npt.NDArray[Any], name: str, *, peak: int | None = None, bit_depth: int | None = None
) -> npt.NDArray[Any]:
    """Stored samples as RGB: v / white, where white is 2^bit_depth - 1, or the full range.

    Grey is repeated in the three channels, and a fourth channel is dropped.

    Args:
        samples: (H, W), or (H, W, 1, 3 or 4); uint8, uint16, or floating-point.
        name: what messages call it.
        peak: the sample that stands for white, where the file names it.
        bit_depth: the number of bits that the camera had, where 16-bit or floating-point samples hold fewer.

    Returns:
        (H, W, 3). uint8 stays so; all others become float32 in [0, 1].

    Raises:
        InputError: another shape or type, NaN or infinite samples, samples above `bit_depth`, or floating-point samples
            that are not in [0, 1] without it.

    Warns:
        UserWarning: 16-bit samples of which the largest is far below the full range, without `bit_depth`.

    >>> to_rgb(np.array([[0, 4095]], np.uint16), "image", bit_depth=12).tolist()
    [[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]]
    """
    check_bit_depth(bit_depth)
    if samples.ndim not in (2, 3) or samples.size == 0 or (samples.ndim == 3 and samples.shape[2] not in (1, 3, 4)):
        raise InputError(f"{name} has shape {samples.shape}; expected (H, W), (H, W, 1), (H, W, 3) or (H, W, 4)")
    samples = samples[:, :, None] if samples.ndim == 2 else samples[:, :, :3]
    if samples.dtype == np.uint8:
        values = _whole(samples, name, peak, bit_depth)
    elif samples.dtype.kind == "u" and samples.dtype.itemsize == 2:
        values = _deep(samples, name, peak, bit_depth)
    elif np.issubdtype(samples.dtype, np.floating):
        values = _floating(samples, name, bit_depth)
    else:
        raise InputError(f"{name} holds {samples.dtype}; expected uint8, uint16, or floating-point in [0, 1]")
    return np.ascontiguousarray(np.broadcast_to(values, (*values.shape[:2], 3)))


def warn_of_other_depths(left: npt.NDArray[Any], right: npt.NDArray[Any]) -> None:
    """Warns where one view of a pair has 8 bits per sample and the other has more."""
    if (left.dtype == np.uint8) != (right.dtype == np.uint8):
        warnings.warn(
            "one image of a pair has 8 bits per sample, the other more: if one of the files is a copy, give both views "
            "of one kind; if 16 bits hold fewer, say how many (bit_depth=12)",
            stacklevel=2,
        )


def _whole(samples: npt.NDArray[Any], name: str, peak: int | None, bit_depth: int | None) -> npt.NDArray[Any]:
    if bit_depth not in (None, 8):
        raise InputError(f"{name} has 8 bits per sample: leave out bit_depth={bit_depth}")
    if peak is None or peak >= 255:
        return samples
    return ((np.minimum(samples, peak).astype(np.uint16) * 255 + peak // 2) // peak).astype(np.uint8)


def _deep(samples: npt.NDArray[Any], name: str, peak: int | None, bit_depth: int | None) -> npt.NDArray[Any]:
    white = peak or 65535
    if bit_depth is not None:
        largest, most = int(samples.max()), 2**bit_depth - 1
        if largest > most:
            raise InputError(f"{name} holds samples up to {largest}; bit_depth={bit_depth} allows {most} at most")
        if peak not in (None, most):
            raise InputError(f"{name} names {peak} as its white; leave out bit_depth={bit_depth}")
        white = most
    elif peak is None and samples.size >= _ENOUGH and 0 < (bits := int(samples.max()).bit_length()) <= _DARK_BITS:
        warnings.warn(
            f"the samples of a 16-bit image need {bits} bits only, so that it looks nearly black: if that is the depth "
            f"of the camera, say so (bit_depth={bits})",
            stacklevel=3,
        )
    values = np.divide(samples, white, dtype=np.float32)
    return np.minimum(values, np.float32(1), out=values)


def _floating(samples: npt.NDArray[Any], name: str, bit_depth: int | None) -> npt.NDArray[Any]:
    with np.errstate(over="ignore"):
        values: npt.NDArray[Any] = samples.astype(np.float32)
    low, high = float(values.min()), float(values.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = np.count_nonzero(~np.isfinite(values))
        raise InputError(f"{name} has {bad} values that are NaN or infinite; expected finite ones in [0, 1]")
    if bit_depth is not None:
        most = 2**bit_depth - 1
        if high <= 1 or high > most or low < 0:
            raise InputError(
                f"{name} is floating-point from {low:g} to {high:g}; bit_depth={bit_depth} takes values from 0 to "
                f"{most}, some above 1"
            )
        values /= np.float32(most)
    # resizing filters overshoot a little
    elif low < -0.05 or high > 1.05:
        hint = "; divide by 255, pass uint8, or say bit_depth" if high > 2 else ""
        raise InputError(f"{name} is floating-point from {low:g} to {high:g}; expected [0, 1]{hint}")
    return values
