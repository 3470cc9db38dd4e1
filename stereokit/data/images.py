"""Images from and to files: 8 and 16 bit, grey and colour, always RGB."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.bit_depth import to_rgb
from stereokit.data.image_formats import EncodedImage, read_header
from stereokit.data.image_formats.png import PNG_MAGIC
from stereokit.errors import InputError, printable
from stereokit.files import atomic_path, read_file_bytes

__all__ = [
    "IMAGE_SUFFIXES",
    "MAX_BYTES",
    "MAX_PIXELS",
    "first_channel",
    "read_image",
    "read_image_depth",
    "read_image_size",
    "read_samples",
    "read_stored",
    "to_uint8",
    "write_image",
    "write_samples",
]

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".webp", ".bmp", ".tif", ".tiff"}
"""Of the files that are taken for images in a folder."""

MAX_PIXELS = 10**8
"""The most pixels a file may claim to hold. Above it a file is refused before memory is reserved for it."""

MAX_BYTES = 2**30
"""The most memory that reading one file may take. What a file would take is known from its header."""


def read_image(path: str | os.PathLike[str], *, bit_depth: int | None = None) -> npt.NDArray[Any]:
    """Reads an image file as RGB.

    PNG, JPEG, PPM/PGM, WebP, BMP and TIFF, of 8 or 16 bits per sample, TIFF of floating point in [0, 1] too. Grey is
    repeated in the three channels. An alpha channel is dropped; of an animated PNG the still picture is read. The
    pixels are those stored: an orientation noted in a photograph's metadata is not applied, because it would turn a
    rectified pair.

    Args:
        path: the file.
        bit_depth: the bits of the camera, where 16-bit or floating-point samples hold fewer: 12 for values to 4095.

    Returns:
        (H, W, 3). uint8 for a file of 8 bits per sample or fewer, float32 in [0, 1] for others.

    Raises:
        InputError: the file is missing, unreadable, no image, truncated, larger than `MAX_PIXELS` or than `MAX_BYTES`
            when decoded, or of other values than `bit_depth` says.

    Warns:
        UserWarning: see `to_rgb`.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.pgm"
    >>> _ = path.write_bytes(b"P5 2 1 255 " + bytes([7, 9]))
    >>> read_image(path).tolist()
    [[[7, 7, 7], [9, 9, 9]]]
    """
    samples, peak = read_stored(path)
    return to_rgb(samples, printable(path), peak=peak, bit_depth=bit_depth)


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
    image = _read_header(path, read_file_bytes(path))
    return image.width, image.height


def read_image_depth(path: str | os.PathLike[str]) -> int:
    """Bits of a sample of an image file as it is decoded, 8 or 16, or 32 and 64 of floating-point TIFF.

    Raises:
        InputError: as `read_image`.
    """
    start = read_file_bytes(path, 32)
    if start.startswith(PNG_MAGIC) and start[12:16] == b"IHDR":
        # of the most usual kind without reading it whole
        return 16 if start[24:25] == b"\x10" else 8
    return 8 * _read_header(path, read_file_bytes(path)).sample_bytes


def read_samples(path: str | os.PathLike[str], *, floating: bool = False) -> npt.NDArray[Any]:
    """Reads the stored sample values of an image file: masks, object maps and disparity as integers.

    Args:
        path: the file.
        floating: whether floating-point samples are taken too.

    Returns:
        uint8, uint16 or floating-point, (H, W) for a grey file, (H, W, 3) RGB or (H, W, 4) RGBA for another.

    Raises:
        InputError: as `read_image`.
    """
    samples = read_stored(path)[0]
    if samples.dtype.kind == "f" and not floating:
        raise InputError(f"{printable(path)} holds {samples.dtype} samples; expected 8 or 16 bits per sample")
    return samples


def first_channel(samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The samples (H, W) of a grey map, which some files repeat in several channels.

    >>> first_channel(np.ones((2, 3, 3), np.uint8)).shape, first_channel(np.ones((2, 3), np.uint8)).shape
    ((2, 3), (2, 3))
    """
    return samples if samples.ndim == 2 else samples[:, :, 0]


def read_stored(path: str | os.PathLike[str]) -> tuple[npt.NDArray[Any], int | None]:
    """The samples of an image file as `read_samples` gives them, and the one that is white where the file names it.

    Raises:
        InputError: as `read_image`.
    """
    data = read_file_bytes(path)
    image = _read_header(path, data)
    # of a pixel, as read_image gives it
    memory = image.memory(3 if image.sample_bytes == 1 else 12) + 2 * len(data)
    if memory > MAX_BYTES:
        raise InputError(
            f"{printable(path)} claims {image.width} x {image.height} pixels, which take {memory // 2**20} MiB to "
            f"decode; expected at most {MAX_BYTES // 2**20} MiB: make it smaller, or cut it"
        )
    try:
        samples = image.decode()
    except ValueError as error:
        raise InputError(f"{printable(path)} is a broken image ({image.format}): {error}") from error
    if samples.shape[:2] != (image.height, image.width):
        raise InputError(
            f"{printable(path)} is a broken image: its {image.format} header names another size than its data"
        )
    return samples, image.peak


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
    name = printable(path)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.size == 0:
        raise InputError(f"{name}: expected an image of shape (H, W, 3), got an array of shape {rgb.shape}")
    suffix = Path(path).suffix.lower()
    suffixes: tuple[str, ...] = (".png", ".ppm", ".tif", ".tiff")
    if rgb.dtype == np.uint8:
        samples, suffixes = rgb, (*suffixes, ".jpg", ".jpeg", ".bmp", ".webp")
    elif rgb.dtype in (np.float32, np.float64):
        if not (np.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1):
            raise InputError(f"{name}: a floating-point image must lie in [0, 1]; divide by 255, or clip it")
        samples = np.rint(rgb * 65535).astype(np.uint16)
    else:
        raise InputError(f"{name}: expected uint8, or float in [0, 1], got {rgb.dtype}")
    if suffix not in suffixes:
        depth = 8 if rgb.dtype == np.uint8 else 16
        raise InputError(f"{name}: {depth}-bit images are written as {', '.join(suffixes)}, not {suffix!r}")
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
            f"{printable(path)}: {samples.dtype} samples of shape {samples.shape} can't be encoded as {suffix!r}"
        )
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _read_header(path: str | os.PathLike[str], data: bytes) -> EncodedImage:
    name = printable(path)
    if not data:
        raise InputError(f"{name} is empty (0 bytes); expected an image")
    try:
        header = read_header(data)
    except ValueError as error:
        raise InputError(f"{name} is a broken image: {error}") from error
    if header is None:
        raise InputError(
            f"{name} is no image that can be read (it begins with {data[:8]!r}); "
            "expected PNG, JPEG, PPM/PGM, WebP, BMP or TIFF"
        )
    if not (header.width > 0 and header.height > 0 and header.width * header.height <= MAX_PIXELS):
        raise InputError(
            f"{name} claims {header.width} x {header.height} pixels; "
            f"expected at least 1 and at most {MAX_PIXELS} in all"
        )
    return header
