"""Disparity as integers in an image: KITTI's, DrivingStereo's, Middlebury's and Sintel's encodings."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import Disparity, PathLike, to_disparity
from stereokit.data.images import first_channel, read_samples, write_samples
from stereokit.errors import InputError, printable

__all__ = [
    "KITTI_SCALE",
    "fits_kitti_png",
    "is_grey",
    "read_drivingstereo_full_png",
    "read_kitti_png",
    "read_scaled_png",
    "read_sintel_png",
    "unscaled",
    "write_kitti_png",
]

KITTI_SCALE = 256
_DRIVINGSTEREO_FULL_SCALE = 128


def read_kitti_png(path: PathLike) -> Disparity:
    """Reads KITTI's encoding: a 16-bit grey PNG of disparity * 256, 0 where unknown.

    Returns:
        (H, W) float32, NaN where unknown.

    Raises:
        InputError: a missing or broken file, or an image of another depth.

    Source: the readme of KITTI's stereo development kit, 2012 and 2015.
    """
    return _read_deep(path, KITTI_SCALE)


def write_kitti_png(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes KITTI's encoding: a 16-bit grey PNG of disparity * 256, 0 where unknown.

    A known disparity below 1/512 is stored as 1/256, because 0 would make it unknown.

    Raises:
        InputError: a negative value or one above 65535 / 256 = 255.996, another shape, another suffix than
            .png, or a file that can't be written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "disparity.png"
    >>> write_kitti_png(path, [[300.0]])
    Traceback (most recent call last):
    ...
    stereokit.errors.InputError: ... holds disparity from 0 to 255.996, got 300.0 to 300.0; write .pfm or .npy
    """
    name = printable(path)
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{name}: KITTI's encoding is written to a file that ends in .png")
    values = to_disparity(path, disparity)
    known = ~np.isnan(values)
    if not fits_kitti_png(values):
        raise InputError(
            f"{name}: KITTI's PNG holds disparity from 0 to 255.996, "
            f"got {values[known].min()} to {values[known].max()}; write .pfm or .npy"
        )
    samples = np.zeros(values.shape, np.uint16)
    samples[known] = np.maximum(np.rint(values[known].astype(np.float64) * KITTI_SCALE), 1)
    write_samples(path, samples, overwrite=overwrite)


def fits_kitti_png(disparity: npt.NDArray[Any]) -> bool:
    """Whether KITTI's encoding holds all known values.

    >>> fits_kitti_png(np.array([0, 255.997, np.nan])), fits_kitti_png(np.array([255.999])), fits_kitti_png(-np.ones(1))
    (True, False, False)
    """
    known = disparity[np.isfinite(disparity)].astype(np.float64)
    return bool(((known >= 0) & (np.rint(known * KITTI_SCALE) <= 65535)).all())


def read_scaled_png(path: PathLike, *, scale: float) -> Disparity:
    """Reads a grey image of disparity * `scale`, 0 where unknown.

    Grey stored as three equal channels is accepted, since some of Middlebury's maps are.

    Args:
        path: an 8- or 16-bit grey image, PNG or PGM.
        scale: the stored value of one pixel of disparity.

    Returns:
        (H, W) float32, NaN where unknown.

    Raises:
        InputError: a missing or broken file, a colour picture, or a scale that is not positive.
    """
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"{printable(path)}: scale must be a positive number, got {scale}")
    samples = read_samples(path, floating=True)
    if samples.dtype.kind == "f":
        raise InputError(f"{printable(path)} holds disparity itself, which has no scale; leave out scale={scale:g}")
    if not is_grey(samples):
        raise InputError(f"{printable(path)} is a colour image; expected grey, of disparity * {scale:g}")
    return unscaled(first_channel(samples), scale)


def read_sintel_png(path: PathLike) -> Disparity:
    """Reads Sintel's encoding, d = 4 R + G / 2^6 + B / 2^14.

    The encoding has no value for unknown: Sintel's disparity is dense.

    Returns:
        (H, W) float32.

    Raises:
        InputError: a missing or broken file, or one that is no 8-bit colour image.

    Source: the development kit of MPI Sintel stereo, `sintel_io.py`.
    """
    samples = read_samples(path)
    if samples.dtype != np.uint8 or samples.ndim != 3:
        raise InputError(f"{printable(path)} is no 8-bit colour image, which Sintel's disparity is")
    red, green, blue = np.moveaxis(samples[:, :, :3].astype(np.float32), -1, 0)
    disparity: Disparity = red * 4 + green / 2**6 + blue / 2**14
    return disparity


def read_drivingstereo_full_png(path: PathLike) -> Disparity:
    """Reads DrivingStereo's full-size maps: a 16-bit grey PNG of disparity * 128, 0 where unknown.

    Its half-size maps are in KITTI's encoding.

    Returns:
        (H, W) float32, NaN where unknown.

    Raises:
        InputError: as `read_kitti_png`.
    """
    return _read_deep(path, _DRIVINGSTEREO_FULL_SCALE)


def is_grey(samples: npt.NDArray[Any]) -> bool:
    """Whether an image has one channel, or three that are equal."""
    return samples.ndim == 2 or bool((samples[:, :, :3] == samples[:, :, :1]).all())


def _read_deep(path: PathLike, scale: int) -> Disparity:
    samples = read_samples(path)
    if samples.dtype != np.uint16 or samples.ndim != 2:
        channels = 1 if samples.ndim == 2 else samples.shape[2]
        raise InputError(
            f"{printable(path)} has {samples.dtype} samples in {channels} channels; expected a 16-bit grey PNG"
        )
    return unscaled(samples, scale)


def unscaled(samples: npt.NDArray[Any], scale: float) -> Disparity:
    """Disparity from stored whole numbers: value / `scale`, NaN for 0."""
    values: Disparity = (samples / np.float64(scale)).astype(np.float32)
    values[samples == 0] = np.nan
    return values
