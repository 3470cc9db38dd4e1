"""What flows: pictures of one view with their time, and frames of both."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

__all__ = ["Image", "Picture", "Shot", "Source", "StereoFrame", "decoded_image"]

Image: TypeAlias = npt.NDArray[Any]
"""(H, W, 3), RGB: uint8, or float32 in [0, 1] where the source has more than 8 bits per sample."""


class Picture(NamedTuple):
    """What one camera saw, and when in seconds, by a clock of its source."""

    image: Image
    time: float


Shot: TypeAlias = tuple[Picture, ...]
"""What a source gives at once: a picture, or those of two cameras."""


class Source(Protocol):
    """A file, folder, camera or stream.

    Attributes:
        name: what messages call it.
        rate: frames per second, None where it does not say.
        length: how many frames it should have, None where it does not say.
        counted: whether `length` is exact.
        damaged: frames that were left out because they did not arrive whole.
    """

    name: str
    rate: float | None
    length: int | None
    counted: bool
    damaged: int

    def __iter__(self) -> Iterator[Shot]:
        """Every frame, in order.

        Raises:
            InputError: it ends before it should.
        """
        ...

    def close(self) -> None:
        """Lets go of the file or the device."""
        ...


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Both views at one time.

    Attributes:
        left: (H, W, 3), RGB: uint8, or float32 in [0, 1] where the source has more than 8 bits per sample.
        right: the same, of the same size.
        index: frames given before this one.
        time: seconds since the first frame, of the left view.
        skew: seconds by which the right view was taken, or of two streams arrived, after the left one.
    """

    left: Image
    right: Image
    index: int
    time: float
    skew: float = 0.0


def decoded_image(frame: Any) -> Image:
    """What PyAV decoded, with all of its bits."""
    if all(component.bits <= 8 for component in frame.format.components):
        image: Image = frame.to_ndarray(format="rgb24")
        return image
    return frame.to_ndarray(format="rgb48le").astype(np.float32) / np.float32(65535)
