"""sensor_msgs/Image and CompressedImage to RGB."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError, printable

__all__ = ["rgb_of"]

_CHANNELS = {
    **dict.fromkeys(("mono8", "8UC1"), 1),
    **dict.fromkeys(("rgb8", "bgr8", "8UC3"), 3),
    **dict.fromkeys(("rgba8", "bgra8", "8UC4"), 4),
}
# by the names that begin at the first pixel, as those of ROS do
_BAYER = {
    f"bayer_{pattern.lower()}8": getattr(cv2, f"COLOR_Bayer{pattern}2RGB")
    for pattern in ("RGGB", "BGGR", "GBRG", "GRBG")
}
_SIXTEEN = ("mono16", "16UC1")


def rgb_of(message: Any) -> npt.NDArray[np.uint8]:
    """The picture of a sensor_msgs/Image or CompressedImage.

    Args:
        message: with `encoding`, `height`, `width`, `step`, `is_bigendian` and `data`: mono8, mono16 (its upper eight
            bits), rgb8, bgr8, rgba8, bgra8, their OpenCV names (8UC3 is BGR), or a Bayer pattern of 8 bits, which
            OpenCV interpolates; or with `format` and `data`, as JPEG or PNG.

    Returns:
        (H, W, 3), RGB.

    Raises:
        InputError: another encoding, or less data than the size asks for.

    Source: REP 118 and `sensor_msgs/image_encodings.hpp`.

    >>> from types import SimpleNamespace
    >>> rgb_of(SimpleNamespace(encoding="bgr8", height=1, width=1, step=3, data=bytes([1, 2, 3]))).tolist()
    [[[3, 2, 1]]]
    """
    data = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        return _decoded(data, str(message.format))
    encoding, height, width, step = message.encoding, message.height, message.width, message.step
    depth = 2 if encoding in _SIXTEEN else 1
    channels = 1 if encoding in _SIXTEEN or encoding in _BAYER else _CHANNELS.get(encoding)
    if channels is None:
        raise InputError(
            f"images of encoding {printable(encoding)} can't be read; expected "
            f"{', '.join((*_CHANNELS, *_SIXTEEN, *_BAYER))}"
        )
    row = width * channels * depth
    if height < 1 or row < 1 or step < row or data.size < step * (height - 1) + row:
        raise InputError(
            f"an image of {width} x {height} px, {encoding}, has {data.size} bytes in rows of {step}; expected rows "
            f"of at least {row}"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    if depth == 2:
        # the upper byte is the last one of each, unless it is big-endian
        rows = rows[:, 0 if message.is_bigendian else 1 :: 2]
    samples = np.ascontiguousarray(rows).reshape(height, width, channels)
    if encoding in _BAYER:
        return np.asarray(cv2.cvtColor(samples, _BAYER[encoding]), np.uint8)
    if channels == 1:
        return np.repeat(samples, 3, axis=2)
    return np.ascontiguousarray(samples[..., :3] if encoding.startswith("rgb") else samples[..., 2::-1])


def _decoded(data: npt.NDArray[np.uint8], kind: str) -> npt.NDArray[np.uint8]:
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if decoded is None:
        raise InputError(f"a compressed image of format {printable(kind)} can't be decoded; expected JPEG or PNG")
    return np.ascontiguousarray(decoded[..., ::-1], np.uint8)
