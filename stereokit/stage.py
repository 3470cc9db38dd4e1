"""One stage of a network: candidates to predictions, once."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import (
    Aggregation,
    Cost,
    Distribution,
    Features,
    Guides,
    Head,
    Prediction,
    Refinement,
    Regression,
    Sampler,
    Upsampler,
)
from stereokit.layers import bilinear_upsample

__all__ = [
    "Stage",
    "StageBlocks",
    "StageOutput",
    "guides_read",
    "levels_of",
    "planes_scale",
    "planes_upscale",
    "regression_guides",
    "resample",
    "run_stage",
    "scales_of",
    "seen_by_regression",
    "stage_loss_weights",
]


class StageBlocks(Protocol):
    """The blocks that make up a stage: of a `Stage`, or of a network itself."""

    stride: int
    candidates: Sampler
    cost: Cost
    coarser_costs: nn.ModuleList
    """Of further strides, twice as large each, where the aggregation has several scales and the backbone maps of them;
    volumes that are missing are averaged from the coarsest there is."""
    aggregation: Aggregation
    regression: Regression
    upsampler: Upsampler


class StageOutput(NamedTuple):
    """What a stage gives."""

    predictions: tuple[Prediction, ...]
    """The supervised ones, the best one last; in eval mode that alone."""
    confidence: Tensor | None
    """(B, H, W), at full resolution. None where it was not asked for, and in training mode."""


class Stage(nn.Module):
    """A stage ahead of the last one, see `run_stage`.

    Args:
        candidates, cost, aggregation, regression, upsampler: see `stereokit.contracts`.
        stride: of the maps that are compared.
        coarser_costs: see `StageBlocks`.
        loss_weight: of all of the stage's predictions.
    """

    def __init__(
        self,
        *,
        candidates: Sampler,
        cost: Cost,
        aggregation: Aggregation,
        regression: Regression,
        upsampler: Upsampler,
        stride: int,
        coarser_costs: Sequence[Cost] = (),
        loss_weight: float = 1.0,
    ) -> None:
        super().__init__()
        self.candidates = candidates
        self.cost = cost
        self.coarser_costs = nn.ModuleList(coarser_costs)  # type: ignore[arg-type]
        self.aggregation = aggregation
        self.regression = regression
        self.upsampler = upsampler
        self.stride = stride
        self.loss_weight = loss_weight

    def forward(self, left: Features, right: Features, guides: Guides, before: Prediction | None) -> StageOutput:
        """Features of both views, and what the stage before predicted, to predictions."""
        return run_stage(self, left, right, guides, before, training=self.training)


def run_stage(
    blocks: StageBlocks,
    left: Features,
    right: Features,
    guides: Guides,
    before: Prediction | None,
    *,
    training: bool,
    confidence: bool = False,
) -> StageOutput:
    """Candidates, cost volume, aggregation, and the regression before or after the upsampling.

    Args:
        blocks: of the stage.
        left: features.
        right: likewise.
        guides: of the left image.
        before: what the stage before predicted; None in the first one.
        training: give all predictions, in place of the best one alone.
        confidence: give that of the best one; not in training.
    """
    stride, upsampler = blocks.stride, blocks.upsampler
    candidates, weights = blocks.candidates(left, right, before)
    volume, planes = _volume(blocks.cost, left, right, stride, candidates, weights)
    scales = scales_of(blocks.aggregation)
    if scales == 1:
        given = blocks.aggregation(volume, guides)
    else:
        volumes = [volume]
        for scale, cost in enumerate(blocks.coarser_costs, start=1):
            volumes.append(_volume(cost, left, right, stride << scale, candidates, weights)[0])
        while len(volumes) < scales:
            volumes.append(F.avg_pool3d(volumes[-1], 2))
        given = blocks.aggregation(volumes, guides)
    heads = [_distribution(head, blocks, stride, planes) for head in (given if training else given[-1:])]
    if not training:
        best = heads[-1]
        disparity, certainty = _regress(best, blocks, guides, candidates, best=True, with_confidence=confidence)
        if certainty is not None:
            ends_at = best.stride // (upsampler.scale if upsampler.domain == "volume" else 1)
            certainty = bilinear_upsample(certainty, ends_at)
        return StageOutput((_upsampled(disparity, best, blocks, guides),), certainty)
    predictions = []
    for number, head in enumerate(heads, start=1):
        coarse, _ = _regress(head, blocks, guides, candidates, best=number == len(heads))
        if upsampler.learned and upsampler.domain == "disparity" and number == len(heads):
            predictions.append(Prediction(coarse, head.stride, head))
        finer = None
        if upsampler.domain == "volume" or candidates is not None:
            finer = partial(seen_by_regression, head, upsampler, guides, candidates)
        predictions.append(_upsampled(coarse, head, blocks, guides)._replace(finer=finer))
    return StageOutput(tuple(predictions), None)


def scales_of(aggregation: Aggregation) -> int:
    """How many volumes an aggregation takes."""
    return int(getattr(aggregation, "scales", 1))


def _volume(
    cost: Any, left: Features, right: Features, stride: int, candidates: Tensor | None, weights: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """The volume of the maps of a stride, and the px of its planes where they are not uniform."""
    maps = left.matching[stride], right.matching[stride]
    planes = None
    if candidates is not None:
        planes = resample(candidates, (cost.planes, *maps[0].shape[-2:]), batch=len(maps[0]))
    volume: Tensor = cost(*maps) if planes is None else cost(*maps, planes / stride)
    if weights is not None:
        volume = volume * resample(weights, tuple(volume.shape[2:]), batch=len(volume)).unsqueeze(1).to(volume.dtype)
    return volume, planes


def guides_read(stages: Sequence[StageBlocks], refinements: Sequence[Refinement]) -> list[int]:
    """The strides of all guides that a network reads."""
    blocks = [block for stage in stages for block in (stage.aggregation, stage.upsampler)]
    read = [stride for block in (*blocks, *refinements) for stride in block.guide_channels]
    return [*read, *(stride for stage in stages for stride in regression_guides(stage.regression))]


def regression_guides(regression: Regression) -> Mapping[int, int]:
    """The guides that a regression reads: channels by stride."""
    guides: Mapping[int, int] = getattr(regression, "guide_channels", {})
    return guides


def stage_loss_weights(blocks: StageBlocks) -> tuple[float, ...]:
    """The weight in the loss of each prediction that a stage gives in training mode."""
    *others, last = blocks.aggregation.loss_weights
    coarse = (0.3 * last,) if blocks.upsampler.learned and blocks.upsampler.domain == "disparity" else ()
    return (*others, *coarse, last)


def resample(values: Tensor, size: tuple[int, ...], *, batch: int) -> Tensor:
    """Candidates (D,) or (B, D, h, w) at another number of planes and another resolution, by interpolation.

    >>> import torch
    >>> resample(torch.tensor([0.0, 4.0, 8.0, 12.0]), (2, 1, 1), batch=1).flatten()
    tensor([ 2., 10.])
    """
    if values.dim() == 1:
        values = values.reshape(1, -1, 1, 1).expand(batch, -1, 1, 1)
        if size[0] != values.shape[1]:
            values = _interpolate(values, (size[0], 1, 1))
        return values.expand(batch, *size)
    return values if tuple(values.shape[1:]) == size else _interpolate(values, size)


def _interpolate(values: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(values.unsqueeze(1), size, mode="trilinear", align_corners=False).squeeze(1)


def _distribution(head: Tensor | Head, blocks: StageBlocks, stride: int, planes: Tensor | None) -> Distribution:
    """What a head gave, with all that is known of its planes; `planes` are the px of those of the volume."""
    logits, offsets, certainty = head if isinstance(head, Head) else Head(head)
    values = None if planes is None else resample(planes, tuple(logits.shape[1:]), batch=len(logits))
    upscale, ours = blocks.aggregation.upscale, planes_upscale(blocks.aggregation)
    # how much coarser a head of another scale is
    coarser = 1 if scales_of(blocks.aggregation) == 1 else blocks.cost.planes * ours // logits.shape[1]
    spacing = blocks.candidates.spacing * coarser / ours
    # a plane that is going to be divided is the middle of the fine ones, the first of which is 0
    fine = spacing / (planes_scale(blocks.upsampler) if blocks.upsampler.domain == "volume" else 1)
    parts = levels_of(blocks.upsampler, logits.shape[1]) / logits.shape[1]
    return Distribution(
        logits,
        stride * coarser // upscale,
        fine * parts,
        (parts - 1) / 2 * fine,
        values=values,
        offsets=offsets,
        certainty=certainty,
    )


def seen_by_regression(
    head: Distribution, upsampler: Upsampler, guides: Guides, candidates: Tensor | None
) -> Distribution:
    """What the regression sees of a head: its logits are upsampled, if the upsampler is one for logits.

    Args:
        head: of the aggregation.
        upsampler: of the stage.
        guides: for the upsampler.
        candidates: of the stage, of which a plane of the volume may hold several; None where they are uniform.

    >>> import torch
    >>> from stereokit.upsampling import TrilinearUpsampler
    >>> coarse = Distribution(torch.zeros(1, 6, 2, 3), stride=4, spacing=4.0)
    >>> fine = seen_by_regression(coarse, TrilinearUpsampler(scale=4, planes_scale=2), {}, None)
    >>> fine.logits.shape, fine.stride, fine.spacing
    (torch.Size([1, 12, 8, 12]), 1, 2.0)
    """
    if upsampler.domain == "volume":
        planes = head.logits.shape[1]
        logits = upsampler(head.logits, guides)
        offsets = None if head.offsets is None else upsampler(head.offsets, guides)
        certainty = None if head.certainty is None else bilinear_upsample(head.certainty, upsampler.scale)
        spacing = head.spacing * planes / logits.shape[1]
        stride = head.stride // upsampler.scale
        head = Distribution(logits, stride, spacing, 0.0, head.values, offsets, certainty)
    values = head.values if candidates is None else candidates
    if values is not None:
        head = head._replace(values=resample(values, tuple(head.logits.shape[1:]), batch=len(head.logits)))
    return head


def planes_upscale(aggregation: Aggregation) -> int:
    """By how much finer the logits of an aggregation are than its volume in the planes."""
    return int(getattr(aggregation, "planes_upscale", aggregation.upscale))


def planes_scale(upsampler: Upsampler) -> int:
    """By which the planes of a volume grow in an upsampler."""
    return int(getattr(upsampler, "planes_scale", upsampler.scale))


def levels_of(upsampler: Upsampler, planes: int) -> int:
    """How many levels the regression sees of so many planes."""
    if upsampler.domain == "disparity":
        return planes
    scale = planes_scale(upsampler)
    return (planes - 1) * scale + 1 if getattr(upsampler, "include_end", False) else planes * scale


def _regress(
    head: Distribution,
    blocks: StageBlocks,
    guides: Guides,
    candidates: Tensor | None,
    *,
    best: bool,
    with_confidence: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """The disparity of a head in px, at the resolution of its logits or, if these are upsampled, of those."""
    seen = seen_by_regression(head, blocks.upsampler, guides, candidates)
    # the fast case: whole numbers of planes
    uniform = seen.values is None and seen.offsets is None
    values = None if uniform else seen.disparities()
    # the heads for training alone are regressed without guides
    given = {"guides": guides} if best and regression_guides(blocks.regression) else {}
    if not with_confidence:
        disparity, confidence = blocks.regression(seen.logits, values, **given), None
    elif seen.certainty is None:
        disparity, confidence = blocks.regression.with_confidence(seen.logits, values, **given)
    else:
        disparity, confidence = blocks.regression(seen.logits, values, **given), seen.certainty.sigmoid()
    return (disparity * seen.spacing if uniform else disparity), confidence


def _upsampled(disparity: Tensor, head: Distribution, blocks: StageBlocks, guides: Guides) -> Prediction:
    """The disparity at the resolution that the upsampler ends at, or at its own of a coarser scale."""
    upsampler = blocks.upsampler
    if upsampler.domain == "disparity":
        if head.stride != blocks.stride // blocks.aggregation.upscale:
            return Prediction(disparity, head.stride, head)
        disparity = upsampler(disparity, guides)
    return Prediction(disparity, head.stride // upsampler.scale, head)
