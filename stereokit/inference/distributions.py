"""What a network says about all candidates of a pair, pixel by pixel."""

import inspect
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from stereokit.contracts import Distribution, Upsampler
from stereokit.errors import ConfigError, InputError
from stereokit.regression import SoftArgmin
from stereokit.stage import seen_by_regression

__all__ = ["Distributions", "PixelDistributions", "find_distributions"]

Array: TypeAlias = npt.NDArray[np.float32]


class PixelDistributions(NamedTuple):
    """The distributions at N pixels, over D candidates."""

    disparities: Array
    """(N, D), px of the candidates in the pair as it was given, ascending where they are uniform."""
    probabilities: Array
    """(N, D), softmax over all of them."""
    kept: npt.NDArray[np.bool_]
    """(N, D), the candidates that the regression keeps: the k largest, or all."""
    expectation: Array
    """(N,), px: what the regression makes of them, before upsampling and refinements."""

    @property
    def spread(self) -> Array:
        """(N,), px: the standard deviation of each whole distribution."""
        mean = (self.probabilities * self.disparities).sum(1, keepdims=True)
        return np.asarray(np.sqrt((self.probabilities * (self.disparities - mean) ** 2).sum(1)), np.float32)


@dataclass(frozen=True, eq=False)
class Distributions:
    """The distributions of the best head of a network for one pair.

    Args:
        head: logits (1, D, h, w) and what is known of their planes.
        regression: what makes a disparity of them.
        upsampler: of the logits, where the network upsamples these before the regression.
        size: height and width of the pair as it was given.
        matched: of the pair as it was matched.
        top: rows of padding above it.
    """

    head: Distribution
    regression: nn.Module
    upsampler: Upsampler | None
    size: tuple[int, int]
    matched: tuple[int, int]
    top: int = 0

    def at(self, rows: npt.ArrayLike, columns: npt.ArrayLike) -> PixelDistributions:
        """The distributions of the cells that pixels lie in.

        Args:
            rows: (N,) of the left image.
            columns: (N,).

        Raises:
            InputError: a pixel outside of the image, or none.
        """
        pixels = [np.atleast_1d(np.asarray(places)) for places in (rows, columns)]
        for places, side, name in zip(pixels, self.size, ("row", "column"), strict=True):
            if not places.size or places.dtype.kind not in "iu" or not ((places >= 0) & (places < side)).all():
                raise InputError(f"expected each {name} as a whole number from 0 to {side - 1}, got {places.tolist()}")
        seen = self.head if self.upsampler is None else seen_by_regression(self.head, self.upsampler, {}, None)
        factors = [matched / side for matched, side in zip(self.matched, self.size, strict=True)]
        row, column = (
            torch.from_numpy(np.floor((places + 0.5) * factor).astype(np.int64))
            for places, factor in zip(pixels, factors, strict=True)
        )
        cells = (row + self.top) // seen.stride, column // seen.stride
        chosen = seen.logits[0][:, cells[0], cells[1]].float()[None, :, None]
        values, spacing = None, seen.spacing
        if seen.values is not None or seen.offsets is not None:
            planes = seen.disparities().expand(seen.logits.shape)
            values = planes[0][:, cells[0], cells[1]][None, :, None].float()
            spacing = 1.0
        levels = chosen.shape[1]
        with torch.inference_mode():
            estimate = self.regression(chosen, values)[0, 0]
            if values is None:
                # one pixel for each candidate, which is sure of it
                certain = torch.eye(levels).reshape(1, levels, 1, levels) * 1e4
                disparities = self.regression(certain)[0, 0][:, None].expand(levels, len(row))
            else:
                disparities = values[0, :, 0]
            probabilities = chosen.softmax(1)[0, :, 0]
            kept = torch.zeros(levels, len(row), dtype=torch.bool)
            k = int(getattr(self.regression, "test_k", levels))
            kept.scatter_(0, chosen[0, :, 0].topk(k, dim=0).indices, True)
        to_given = spacing / factors[1]
        return PixelDistributions(
            (disparities.T * to_given).float().numpy(),
            np.ascontiguousarray(probabilities.T.numpy()),
            np.ascontiguousarray(kept.T.numpy()),
            (estimate * to_given).float().numpy(),
        )


def find_distributions(
    network: nn.Module, left: Tensor, right: Tensor, *, size: tuple[int, int] | None = None
) -> Distributions:
    """Matches a pair and keeps what the network says about all candidates.

    Args:
        network: in eval mode.
        left: (1, 3, H, W), on the network's device, as `network(left, right)` takes it.
        right: likewise.
        size: of the pair before it was scaled for the network; that of `left` by default.

    Raises:
        ConfigError: the network has no distribution.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=64).eval()
    >>> found = find_distributions(model, *torch.rand(2, 1, 3, 64, 64)).at([20], [40])
    >>> found.probabilities.shape, round(float(found.probabilities.sum()), 4)
    ((1, 16), 1.0)
    """
    given: Any = None
    if "return_logits" in inspect.signature(network.forward).parameters:
        with torch.inference_mode():
            given = network(left, right, return_logits=True)
    head: Distribution | None = None if given is None else given.distribution
    if head is None:
        raise ConfigError(
            f"{type(network).__name__} gives no distribution over candidates: it finds disparity without one"
        )
    upsampler: Any = getattr(network, "upsampler", None)
    if getattr(upsampler, "domain", "disparity") != "volume":
        upsampler = None
    elif upsampler.guide_channels:
        raise ConfigError(f"{type(upsampler).__name__} needs guides, and can't be repeated at single pixels")
    height, width = matched = (left.shape[-2], left.shape[-1])
    preprocessing = getattr(network, "preprocessing", None)
    multiple = int(getattr(network, "multiple", 1))
    above = preprocessing is not None and preprocessing.corner == "top_right"
    return Distributions(
        head._replace(
            logits=head.logits.cpu(), values=_on_cpu(head.values), offsets=_on_cpu(head.offsets), certainty=None
        ),
        getattr(network, "regression", None) or SoftArgmin(),
        upsampler,
        size or matched,
        (height, width),
        -height % multiple if above else 0,
    )


def _on_cpu(values: Tensor | None) -> Tensor | None:
    return None if values is None else values.cpu()
