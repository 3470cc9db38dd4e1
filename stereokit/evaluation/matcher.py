"""What can be evaluated: any callable from two images to a disparity map."""

import os
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy.typing as npt
import torch

from stereokit.data.disparity_arrays import Disparity
from stereokit.data.inputs import to_pair
from stereokit.inference import Predictor
from stereokit.inference.predictor import check_finite
from stereokit.inference.shifting import shift_right
from stereokit.runtime.memory import running_out_as
from stereokit.runtime.provenance import file_sha256
from stereokit.weights.opening import NetworkPlace, find_network

__all__ = ["BatchMatcher", "Image", "Matcher", "NetworkMatcher", "describe_matcher"]

Image: TypeAlias = npt.NDArray[Any]
"""(H, W, 3), RGB, uint8 or float32 in [0, 1]."""


class Matcher(Protocol):
    """Any callable from a rectified pair to the disparity of its left image."""

    def __call__(self, left: Image, right: Image, /) -> Any:
        """Left and right image to disparity: an array or a tensor (H, W), in pixels, not finite where unknown."""


@runtime_checkable
class BatchMatcher(Protocol):
    """A matcher that can also take several pairs of one size and type at once."""

    def match_batch(self, lefts: Sequence[Image], rights: Sequence[Image]) -> Sequence[Any]:
        """The disparities of the pairs, in their order."""


class NetworkMatcher:
    """A network as a matcher, one pair or a batch at a time; a predictor that scales or cuts takes one pair at a time.

    Args:
        predictor: the network on its device.
        weights: the name or place that the network was opened from, see `stereokit.open_network`; the record of an
            evaluation holds it, with the hash of its file.

    >>> import numpy as np
    >>> from stereokit import build_model
    >>> matcher = NetworkMatcher(Predictor(build_model("coex", max_disparity=64), device="cpu"))
    >>> images = np.zeros((3, 40, 50, 3), np.uint8)
    >>> [disparity.shape for disparity in matcher.match_batch(images, images)]
    [(40, 50), (40, 50), (40, 50)]
    """

    preparation_seconds: float
    """That the last call took for what is needed once, or once for a size; see `DisparityResult`."""

    def __init__(self, predictor: Predictor, *, weights: str | os.PathLike[str] | NetworkPlace | None = None) -> None:
        self.predictor = predictor
        self.weights = weights
        self.preparation_seconds = 0.0

    def __call__(self, left: Image, right: Image) -> Disparity:
        """Matches one pair."""
        return self.match_batch([left], [right])[0]

    def match_batch(self, lefts: Sequence[Image], rights: Sequence[Image]) -> list[Disparity]:
        """Matches pairs of one size and type in one pass through the network.

        Raises:
            InputError: images that can't be used, or too many of them for the device's memory.
        """
        if len(lefts) == 1 or not self.predictor.whole:
            results = [self.predictor(left, right) for left, right in zip(lefts, rights, strict=True)]
            self.preparation_seconds = sum(result.preparation_seconds for result in results)
            return [result.disparity for result in results]
        depth = self.predictor.bit_depth
        pairs = [to_pair(left, right, bit_depth=depth) for left, right in zip(lefts, rights, strict=True)]
        left, right = (torch.cat(views) for views in zip(*pairs, strict=True))
        height, width = left.shape[-2:]
        right = shift_right(right, self.predictor.min_disparity)
        with running_out_as(
            f"{len(pairs)} pairs of {width} x {height} pixels at once do not fit into the memory of "
            f"{self.predictor.device}; choose a smaller --batch, or --device cpu"
        ):
            self.preparation_seconds = self.predictor.backend.prepare(left, right)
            disparities = self.predictor.backend(left, right).disparity
        for disparity in disparities:
            check_finite(disparity, self.predictor.backend)
        return list(disparities + self.predictor.min_disparity)

    def describe(self) -> dict[str, Any]:
        """The network's configuration and weights, and what ran it, in plain JSON."""
        parts: dict[str, Any] = {"matcher": "network", **self.predictor.describe()}
        if self.weights is not None:
            place = find_network(self.weights)
            parts["weights"] = place.name
            file = place.file()
            if file is not None and file.suffix == ".xml":
                # OpenVINO's graph, whose weights lie beside it
                parts["graph_file_sha256"] = file_sha256(file)
                file = file.with_suffix(".bin")
            if file is not None:
                parts["weights_file_sha256"] = file_sha256(file)
        return parts


def describe_matcher(matcher: Matcher) -> dict[str, Any]:
    """What a matcher is, in plain JSON: its own `describe()` where it has one, else its name.

    >>> def my_matcher(left, right):
    ...     return left[:, :, 0] * 0.0
    >>> describe_matcher(my_matcher)["name"].endswith("my_matcher")
    True
    """
    own = getattr(matcher, "describe", None)
    if callable(own):
        return dict(own())
    named = matcher if hasattr(matcher, "__qualname__") else type(matcher)
    return {"matcher": "callable", "name": f"{named.__module__}.{named.__qualname__}"}
