"""What each slot takes and gives.

A network made of slots is one choice for each of them, once or from coarse to fine::

    left, right ─▶ Backbone ─▶ features of both views, by stride
       ┌──────────────── stage ─────────────────────────────────────────────────────┐
       │ Candidates ─▶ Cost ─▶ Aggregation (+ Guidance) ─▶ Upsampler¹ ─▶ Regression │ ─▶ Prediction
       └────────▲──────────────────────── prediction before ────────────────────────┘
    ─▶ Upsampler² ─▶ Refinements ─▶ disparity
    ¹ if it acts on logits   ² if it acts on disparity

The protocols below are all that a component owes its neighbours; a plain `torch.nn.Module` with these attributes
fits. Strides are in pixels of the padded input: a map of stride 4 has a quarter of its height and width. Disparities
are in pixels of the full-size image, unless said otherwise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from stereokit.layers import bilinear_upsample, bin_shift

__all__ = [
    "Aggregation",
    "Backbone",
    "Candidates",
    "Cost",
    "Distribution",
    "FeatureInfo",
    "Features",
    "GuidanceFactory",
    "GuidancePlacement",
    "Guides",
    "Head",
    "PairedBackbone",
    "Prediction",
    "Refinement",
    "Regression",
    "Sampler",
    "StereoOutput",
    "Upsampler",
]

Guides = Mapping[int, Tensor]
"""Feature maps of the left image by stride, each (B, C, H / stride, W / stride). Stride 1 is the normalised image,
where a backbone gives nothing else."""

GuidancePlacement = Literal["one", "full"]
"""Guidance at the finest scale of the aggregation only, or at every scale."""


class Features(NamedTuple):
    """What a backbone returns for a batch of images."""

    matching: Mapping[int, Tensor]
    """The maps that costs compare, by stride, each (B, C, H / stride, W / stride). Most backbones have one."""
    guides: Mapping[int, Tensor]
    """Maps that guide aggregation, upsampling and refinement, by stride."""


@dataclass(frozen=True)
class FeatureInfo:
    """Channels of a backbone's `Features`, by stride.

    >>> info = FeatureInfo(matching_channels={4: 96}, guide_channels={2: 32, 4: 96, 8: 64})
    >>> info.channels_at(8), info.channels_at(32), info.channels_at(1)
    (64, 64, 3)
    """

    matching_channels: Mapping[int, int]
    guide_channels: Mapping[int, int]

    @property
    def finest(self) -> int:
        """The finest stride that has a matching map."""
        return min(self.matching_channels)

    @property
    def coarsest_guide(self) -> int:
        """Stride of the coarsest guide, 0 without one; the network averages it down where a coarser one is wanted."""
        return max(self.guide_channels, default=0)

    def channels_at(self, stride: int) -> int | None:
        """Channels of the guide at `stride`, given or averaged down from the coarsest; None where there is none."""
        if self.guide_channels and stride > self.coarsest_guide and stride % self.coarsest_guide == 0:
            return self.guide_channels[self.coarsest_guide]
        return self.guide_channels.get(stride, 3 if stride == 1 else None)


class Candidates(NamedTuple):
    """The disparities that one stage looks at."""

    values: Tensor | None = None
    """(D,) or (B, D, h, w), in px, at any resolution; None where they are uniform from 0 and as far apart as the pixels
    of the maps that are compared, for which costs have a fast form."""
    weights: Tensor | None = None
    """(B, D, h, w): their probability in the stage before, by which the volume is multiplied."""


class Head(NamedTuple):
    """What one head of an aggregation says about the planes; a bare tensor stands for its logits."""

    logits: Tensor
    """(B, D, h, w), larger is better."""
    offsets: Tensor | None = None
    """(B, D, h, w), any numbers: see `Distribution`."""
    certainty: Tensor | None = None
    """(B, h, w), any numbers: their sigmoid is how sure the network is, where it says so itself."""


class Distribution(NamedTuple):
    """What one head of an aggregation says about the candidates."""

    logits: Tensor
    """(B, D, h, w), larger is better."""
    stride: int
    """Of the logits."""
    spacing: float
    """px between planes, where they are uniform."""
    first: float = 0.0
    """px of the first plane, where they are uniform."""
    values: Tensor | None = None
    """px of each plane, (D,) or (B, D, h, w), where they are not uniform."""
    offsets: Tensor | None = None
    """(B, D, h, w), any numbers: `bin_shift` of them is how far a plane lies on the way to the next one."""
    certainty: Tensor | None = None
    """(B, h, w), as in `Head`."""

    def disparities(self) -> Tensor:
        """Px of each plane with its offset, broadcastable to the logits.

        >>> Distribution(torch.zeros(1, 3, 1, 1), stride=4, spacing=2.0, first=1.0).disparities().flatten()
        tensor([1., 3., 5.])
        """
        if self.values is None:
            levels = torch.arange(self.logits.shape[1], device=self.logits.device)
            planes = (self.first + self.spacing * levels).reshape(1, -1, 1, 1)
        else:
            planes = self.values.reshape(1, -1, 1, 1) if self.values.dim() == 1 else self.values
        if self.offsets is None:
            return planes
        apart: Tensor | float = self.spacing
        if self.values is not None:
            apart = planes.diff(dim=1)
            apart = torch.cat((apart, apart[:, -1:]), dim=1)
        return planes + apart * bin_shift(self.offsets)


class Prediction(NamedTuple):
    """One supervised output of a network, at its own resolution."""

    disparity: Tensor
    """(B, h, w), in px. At a stride above 1 it covers the padded input."""
    stride: int = 1
    distribution: Distribution | None = None
    """What a head said, where there is such a thing."""
    quantile: float | None = None
    """That it stands for, where it is not the expected value."""
    finer: Callable[[], Distribution] | None = None
    """Makes the distribution at the resolution at which it was regressed, where that is another one."""

    def regressed(self) -> Distribution | None:
        """The distribution that the disparity was regressed from; it is made anew, so that nobody need keep it."""
        return self.distribution if self.finer is None else self.finer()


class StereoOutput(NamedTuple):
    """What every network returns, in training and in eval mode alike."""

    disparity: Tensor
    """(B, H, W), pixels of the left image."""
    predictions: tuple[Prediction, ...] = ()
    """For the loss, weighed by `loss_weights` of the network, the best one last. In eval mode there are none unless
    asked for."""
    confidence: Tensor | None = None
    """(B, H, W) in [0, 1]: the probability mass behind the estimate. None in training mode."""

    @property
    def auxiliary(self) -> tuple[Tensor, ...]:
        """All predictions but the last as (B, H, W): coarse ones are interpolated, and cut to the size of the image."""
        return tuple(at_full_size(p, self.disparity.shape[-2:]) for p in self.predictions[:-1])

    @property
    def logits(self) -> Tensor | None:
        """(B, D', H', W') of the best head, larger is better, of the padded input; None where there are none."""
        distribution = self.distribution
        return None if distribution is None else distribution.logits

    @property
    def distribution(self) -> Distribution | None:
        """Of the best head; None where there is none."""
        return next((p.distribution for p in reversed(self.predictions) if p.distribution is not None), None)


def at_full_size(prediction: Prediction, size: Sequence[int] | None = None) -> Tensor:
    """The disparity of a prediction at stride 1, interpolated; values are not scaled.

    Args:
        prediction: at any stride.
        size: height and width that the result is cut to, at the bottom and right; None leaves it whole.

    >>> import torch
    >>> at_full_size(Prediction(torch.full((1, 2, 3), 7.0), stride=4), (7, 9)).shape
    torch.Size([1, 7, 9])
    """
    disparity = bilinear_upsample(prediction.disparity, prediction.stride)
    if size is None:
        return disparity
    height, width = size
    return disparity[:, :height, :width]


class GuidanceFactory(Protocol):
    """Makes one guidance block: a class such as `GCE`, or a partial of one."""

    def __call__(self, *, guide_channels: int, volume_channels: int) -> nn.Module:
        """A module ``(volume (B, C, D, H, W), guide (B, G, H, W)) -> volume`` of the volume's shape.

        Aggregations of 2D convolutions give it their maps as volumes of depth 1.
        """


class Backbone(Protocol):
    """Images to features, shared by both views."""

    info: FeatureInfo
    multiple: int
    """Height and width of the input are multiples of this."""

    def __call__(self, images: Tensor) -> Features:
        """(B, 3, H, W) normalised images to features."""


class PairedBackbone(Protocol):
    """A backbone that does not treat both views alike, or makes guides of the left one alone."""

    info: FeatureInfo
    multiple: int
    paired: Literal[True]
    """By this it is known."""

    def __call__(self, left: Tensor, right: Tensor) -> tuple[Features, Features]:
        """Two (B, 3, H, W) normalised images to the features of each, the right ones without guides."""


class Sampler(Protocol):
    """Chooses the candidates of a stage."""

    planes: int
    """Of the cost volume."""
    spacing: float
    """px between planes, where they are uniform; else the finest that there may be."""
    fixed: bool
    """Whether the candidates are uniform from 0, one for each pixel of the maps: then `values` is None."""

    def __call__(self, left: Features, right: Features, before: Prediction | None) -> Candidates:
        """Features of both views, and what the stage before predicted, to candidates."""


class Cost(Protocol):
    """Left and right matching features to a cost volume."""

    in_channels: int
    out_channels: int
    planes: int
    warps: bool
    """Whether it takes candidates; may be left out where it does not."""

    def __call__(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Two (B, in_channels, h, w) maps to (B, out_channels, planes, h, w).

        `candidates` are (B, planes, h, w), in pixels of the maps; None for 0, 1, ..., planes - 1.
        """


class Aggregation(Protocol):
    """Cost volume to logits, with the help of the guides."""

    in_channels: int
    guide_channels: Mapping[int, int]
    """The guides that it reads: channels by stride. Empty without guidance."""
    multiple: int
    """Height and width of the volume are multiples of this."""
    planes_multiple: int
    """The number of planes is a multiple of this."""
    upscale: int
    """The logits are this many times finer than the volume, in all three dimensions; in the planes by the attribute
    `planes_upscale`, where there is one."""
    scales: int
    """How many volumes it takes, each half the size of the one before in all three dimensions; 1 may be left out."""
    loss_weights: tuple[float, ...]
    """Weight in the loss of each head, in their order."""
    volume_heads: tuple[str, ...]
    """Submodules that turn volumes into logits (B, 1, D, h, w), by name: "with_offsets" puts others in their place,
    which give twice the batch. May be left out where there are none."""

    def __call__(self, volume: Any, guides: Guides) -> tuple[Tensor | Head, ...]:
        """(B, in_channels, D, h, w) to one (B, D * upscale, h * upscale, w * upscale) per head, the best one last.

        With several scales it takes the volumes from fine to coarse; heads of coarser scales have as many fewer planes.
        In eval mode it may return the last head alone.
        """


class Regression(Protocol):
    """Logits to disparity."""

    min_levels: int
    """The fewest levels that it can work on."""

    def __call__(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, h, w) logits, larger is better, to (B, h, w), the expected candidate (0, 1, ..., D - 1 by default).

        `candidates` are (D,), or broadcastable to the logits.

        One that has `guide_channels`, as aggregations do, takes `guides=...` besides, the guides by stride; heads that
        are for training alone are regressed without.
        """

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What `__call__` gives, and (B, h, w) in [0, 1]: the probability mass behind the estimate."""


class Upsampler(Protocol):
    """From the stride of the logits to full resolution, or to that of the first refinement."""

    scale: int
    """By which height and width grow."""
    domain: Literal["volume", "disparity"]
    """What it upsamples: the logits before the regression, or the disparity after it."""
    learned: bool
    """Whether it has weights; the network then trains on the coarse disparity too."""
    guide_channels: Mapping[int, int]

    def __call__(self, x: Tensor, guides: Guides) -> Tensor:
        """Logits (B, D, h, w) to (B, D * scale, H, W), or disparity (B, h, w) to (B, H, W), its values unchanged.

        One of domain "volume" may have an attribute `planes_scale`, by which the planes grow in place of `scale`; and a
        true `include_end`, where (D - 1) * planes_scale + 1 planes come of D.
        """


class Refinement(Protocol):
    """Mends a disparity."""

    stride: int
    """Of what it gives. It takes that stride or a coarser one."""
    multiple: int
    """Height and width of what it gives are multiples of this; 1 may be left out."""
    guide_channels: Mapping[int, int]
    loss_weight: float

    def __call__(self, disparity: Tensor, left: Tensor, right: Tensor, guides: Guides) -> Tensor:
        """Disparity (B, h, w) and the normalised, padded images (B, 3, H, W) to (B, H / stride, W / stride)."""
