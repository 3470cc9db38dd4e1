"""Images from and to files: 8 and 16 bit, grey and colour, always RGB."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.image_header import ImageHeader, read_image_header
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = [
    "IMAGE_SUFFIXES",
    "MAX_PIXELS",
    "read_file_bytes",
    "read_image",
    "read_image_size",
    "read_samples",
    "to_uint8",
    "write_image",
    "write_samples",
]

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".webp", ".bmp", ".tif", ".tiff"}
"""Of the files that are taken for images in a folder."""

MAX_PIXELS = 10**8
"""The most pixels a file may claim to hold. Above it a file is refused before memory is reserved for it."""

_MAX_BYTES = 16 * MAX_PIXELS


def read_image(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """Reads an image file as RGB.

    PNG, JPEG, PPM/PGM, WebP, BMP and TIFF, of 8 or 16 bits per sample. Grey is repeated in the three
    channels. An alpha channel is dropped. The pixels are those stored: an orientation noted in a
    photograph's metadata is not applied, because it would turn a rectified pair.

    Returns:
        (H, W, 3). uint8 for a file of 8 bits per sample or fewer, float32 in [0, 1] for one of 16 bits.

    Raises:
        InputError: the file is missing, unreadable, no image, truncated, or larger than `MAX_PIXELS`.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.pgm"
    >>> _ = path.write_bytes(b"P5 2 1 255 " + bytes([7, 9]))
    >>> read_image(path).tolist()
    [[[7, 7, 7], [9, 9, 9]]]
    """
    samples, header = _decode(path)
    rgb = np.repeat(samples[:, :, None], 3, axis=2) if samples.ndim == 2 else samples[:, :, :3]
    full = 65535 if rgb.dtype == np.uint16 else 255
    peak = header.peak or full
    if full == 65535:
        rgb = np.divide(np.minimum(rgb, peak), peak, dtype=np.float32)
    elif peak < full:
        rgb = ((np.minimum(rgb, peak).astype(np.uint16) * full + peak // 2) // peak).astype(np.uint8)
    return np.ascontiguousarray(rgb)


def to_uint8(image: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """An image of 8 bits per sample: itself, or floats in [0, 1] rounded; what lies outside is clipped.

    >>> to_uint8(np.array([-0.1, 0.5, 1.0, 1.2])).tolist()
    [0, 128, 255, 255]
    """
    return image if image.dtype == np.uint8 else np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def read_image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height of an image file in pixels, from its header.

    Raises:
        InputError: as `read_image`.
    """
    header = _read_header(path, read_file_bytes(path))
    return header.width, header.height


def read_samples(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """Reads the stored sample values of an image file: masks, object maps and disparity as integers.

    Returns:
        uint8 or uint16, (H, W) for a grey file, (H, W, 3) RGB or (H, W, 4) RGBA for another.

    Raises:
        InputError: as `read_image`.
    """
    return _decode(path)[0]


def write_image(path: str | os.PathLike[str], rgb: npt.NDArray[Any], *, overwrite: bool = False) -> None:
    """Writes an RGB image, in the format that the suffix names.

    Args:
        path: ends in .png, .ppm, .tif or .tiff for either depth, or in .jpg, .jpeg, .bmp or .webp for uint8.
        rgb: (H, W, 3). uint8 is stored with 8 bits, float32 or float64 in [0, 1] with 16 bits per sample.
        overwrite: replace an existing file.

    Raises:
        InputError: an array of another shape, type or range, a suffix that can't hold it, or a file that
            can't be written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "red.png"
    >>> write_image(path, np.full((2, 2, 3), [255, 0, 0], np.uint8))
    >>> read_image(path)[0, 0].tolist()
    [255, 0, 0]
    """
    rgb = np.asarray(rgb)
    name = os.fspath(path)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.size == 0:
        raise InputError(f"{name!r}: expected an image of shape (H, W, 3), got an array of shape {rgb.shape}")
    suffix = Path(path).suffix.lower()
    suffixes: tuple[str, ...] = (".png", ".ppm", ".tif", ".tiff")
    if rgb.dtype == np.uint8:
        samples, suffixes = rgb, (*suffixes, ".jpg", ".jpeg", ".bmp", ".webp")
    elif rgb.dtype in (np.float32, np.float64):
        if not (np.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1):
            raise InputError(f"{name!r}: a floating-point image must lie in [0, 1]; divide by 255, or clip it")
        samples = np.rint(rgb * 65535).astype(np.uint16)
    else:
        raise InputError(f"{name!r}: expected uint8, or float in [0, 1], got {rgb.dtype}")
    if suffix not in suffixes:
        depth = 8 if rgb.dtype == np.uint8 else 16
        raise InputError(f"{name!r}: {depth}-bit images are written as {', '.join(suffixes)}, not {suffix!r}")
    write_samples(path, samples, overwrite=overwrite)


def write_samples(path: str | os.PathLike[str], samples: npt.NDArray[Any], *, overwrite: bool) -> None:
    """Writes sample values as they are: uint8 or uint16, (H, W) or RGB (H, W, 3), in the suffix's format."""
    bgr = samples[:, :, ::-1] if samples.ndim == 3 else samples
    suffix = Path(path).suffix.lower()
    try:
        encodable, encoded = cv2.imencode(suffix, np.ascontiguousarray(bgr))
    except cv2.error:
        encodable = False
    if not encodable:
        raise InputError(
            f"{os.fspath(path)!r}: {samples.dtype} samples of shape {samples.shape} can't be encoded as {suffix!r}"
        )
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(encoded.tobytes())


def read_file_bytes(path: str | os.PathLike[str], limit: int | None = None) -> bytes:
    """The content of a regular file, or its first `limit` bytes.

    Raises:
        InputError: no such file, a folder, a device, a file that may not be read, or one too large to be a
            picture of `MAX_PIXELS`.
    """
    name = os.fspath(path)
    try:
        if not os.path.exists(path):
            raise InputError(f"{name!r} does not exist")
        if not os.path.isfile(path):
            kind = "a folder" if os.path.isdir(path) else "a device or a pipe"
            raise InputError(f"{name!r} is {kind}; expected a file")
        if limit is None and os.path.getsize(path) > _MAX_BYTES:
            raise InputError(f"{name!r} has {os.path.getsize(path)} bytes; expected at most {_MAX_BYTES}")
        with open(path, "rb") as file:
            return file.read() if limit is None else file.read(limit)
    except OSError as error:
        raise InputError(f"{name!r} can't be read: {error.strerror or error}") from error


def _decode(path: str | os.PathLike[str]) -> tuple[npt.NDArray[Any], ImageHeader]:
    data = read_file_bytes(path)
    header = _read_header(path, data)
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise InputError(f"{os.fspath(path)!r} is a broken image: its {header.format} data can't be decoded")
    if decoded.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{os.fspath(path)!r} holds {decoded.dtype} samples; expected 8 or 16 bits per sample")
    if decoded.ndim == 2:
        return decoded, header
    to_rgb = cv2.COLOR_BGR2RGB if decoded.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
    return cv2.cvtColor(decoded, to_rgb), header


def _read_header(path: str | os.PathLike[str], data: bytes) -> ImageHeader:
    name = os.fspath(path)
    if not data:
        raise InputError(f"{name!r} is empty (0 bytes); expected an image")
    try:
        header = read_image_header(data)
    except ValueError as error:
        raise InputError(f"{name!r} is a broken image: {error}") from error
    if header is None:
        raise InputError(
            f"{name!r} is no image that can be read (it begins with {data[:8]!r}); "
            "expected PNG, JPEG, PPM/PGM, WebP, BMP or TIFF"
        )
    if not (header.width > 0 and header.height > 0 and header.width * header.height <= MAX_PIXELS):
        raise InputError(
            f"{name!r} claims {header.width} x {header.height} pixels; "
            f"expected at least 1 and at most {MAX_PIXELS} in all"
        )
    return header
