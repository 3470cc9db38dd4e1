"""The disparity of every frame of a video or a camera."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from stereokit.errors import InputError
from stereokit.inference.predictor import Predictor
from stereokit.inference.result import DisparityResult
from stereokit.video.frames import StereoFrame

__all__ = ["FrameResult", "match_video"]


class FrameResult(NamedTuple):
    """A frame and its disparity."""

    frame: StereoFrame
    result: DisparityResult


def match_video(predict: Predictor, video: Iterable[StereoFrame]) -> Iterator[FrameResult]:
    """Matches frame after frame.

    Args:
        predict: matches a pair.
        video: of rectified frames, see `stereokit.video.open_stereo_video`. Of a live one the frames are passed over
            that come while another one is matched.

    Raises:
        InputError: a frame that can't be matched; and see `StereoVideo`.

    >>> import numpy as np
    >>> view = np.zeros((40, 60, 3), np.uint8)
    >>> for frame, result in match_video(Predictor("coex", device="cpu"), [StereoFrame(view, view, 0, 0.0)]):
    ...     print(frame.index, result.size)
    0 (40, 60)
    """
    for frame in video:
        try:
            result = predict(frame.left, frame.right)
        except InputError as error:
            raise InputError(f"frame {frame.index}: {error}") from error
        yield FrameResult(frame, result)
