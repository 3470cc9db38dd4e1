"""Networks made of slots: one choice for each of them."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.candidates.uniform import UniformCandidates
from stereokit.checks import check_network, input_multiple
from stereokit.config import NetworkConfig
from stereokit.contracts import (
    Aggregation,
    Backbone,
    Cost,
    Features,
    PairedBackbone,
    Prediction,
    Refinement,
    Regression,
    Sampler,
    StereoOutput,
    Upsampler,
)
from stereokit.network import MIN_SIZE, Preprocessing, StereoNetwork
from stereokit.stage import Stage, StageBlocks, guides_read, run_stage, stage_loss_weights

__all__ = ["StereoModel"]


class StereoModel(StereoNetwork):
    """A `StereoNetwork` through a backbone, stages from coarse to fine, and refinements.

    `build_model` makes one by name. The last stage is the network's own: `candidates`, `cost`, `aggregation`,
    `regression` and `upsampler`.

    Args:
        backbone, cost, aggregation, regression, upsampler: see `stereokit.contracts`.
        max_disparity: D, in pixels; estimates lie in [0, D).
        candidates: of the last stage; None for uniform ones.
        stride: of the maps that the last stage compares; None for the backbone's finest.
        coarser_costs: of the last stage, see `StageBlocks`.
        coarse: the stages ahead of it.
        refinements: what mends the disparity in the end.
        preprocessing: normalisation and padding.
        config: what rebuilds the network, see `ModelConfig`.

    Raises:
        ConfigError: neighbouring blocks do not fit.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=64).eval()
    >>> left = right = torch.rand(1, 3, 50, 70)
    >>> model(left, right).disparity.shape
    torch.Size([1, 50, 70])
    """

    def __init__(
        self,
        *,
        backbone: Backbone,
        cost: Cost,
        aggregation: Aggregation,
        regression: Regression,
        upsampler: Upsampler,
        max_disparity: int,
        candidates: Sampler | None = None,
        stride: int | None = None,
        coarser_costs: Sequence[Cost] = (),
        coarse: Sequence[Stage] = (),
        refinements: Sequence[Refinement] = (),
        preprocessing: Preprocessing | None = None,
        config: NetworkConfig | None = None,
    ) -> None:
        super().__init__(max_disparity=max_disparity, preprocessing=preprocessing, config=config)
        self.stride = backbone.info.finest if stride is None else stride
        self.backbone = backbone
        if candidates is None:
            candidates = UniformCandidates(max_disparity=max_disparity, stride=self.stride)
        self.candidates = candidates
        self.cost = cost
        self.coarser_costs = nn.ModuleList(coarser_costs)  # type: ignore[arg-type]
        self.aggregation = aggregation
        self.regression = regression
        self.upsampler = upsampler
        self.coarse = nn.ModuleList(coarse)
        self.refinements = nn.ModuleList(refinements)  # type: ignore[arg-type]
        stages: tuple[StageBlocks, ...] = (*coarse, self)
        check_network(backbone=backbone, stages=stages, refinements=refinements, max_disparity=max_disparity)
        self.multiple = input_multiple(backbone, stages, refinements)
        limited = (backbone, *(stage.aggregation for stage in stages))
        self.least_size = max(MIN_SIZE, *(getattr(block, "least_size", 0) for block in limited))
        weights = [stage.loss_weight * weight for stage in coarse for weight in stage_loss_weights(stage)]
        self.loss_weights = (*weights, *stage_loss_weights(self), *(r.loss_weight for r in refinements))

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        of_left, of_right = self._features(left, right)
        predictions: list[Prediction] = []
        before = None
        for stage in self.coarse:
            outcome = stage(of_left, of_right, of_left.guides, before)
            predictions += outcome.predictions
            before = outcome.predictions[-1]._replace(disparity=outcome.predictions[-1].disparity.detach())
        outcome = run_stage(self, of_left, of_right, of_left.guides, before, training=self.training, confidence=True)
        predictions += outcome.predictions
        for refinement in self.refinements:
            disparity = refinement(predictions[-1].disparity, left, right, of_left.guides)
            predictions.append(Prediction(disparity, int(refinement.stride)))  # type: ignore[arg-type]
        if not self.training:
            # the distribution is that of the last stage, whatever mended its disparity
            predictions = [predictions[-1]._replace(distribution=outcome.predictions[-1].distribution)]
        return StereoOutput(predictions[-1].disparity, tuple(predictions), outcome.confidence)

    def _features(self, left: Tensor, right: Tensor) -> tuple[Features, Features]:
        """Features of both views, the guides of the left one alone; what is missing is averaged, or the image."""
        of_left, of_right = self._of_both(left, right)
        guides = dict(of_left.guides)
        coarsest = self.backbone.info.coarsest_guide
        for stride in guides_read((*self.coarse, self), self.refinements):  # type: ignore[arg-type]
            if stride == 1 and stride not in guides:
                guides[stride] = left
            elif stride not in guides:
                guides[stride] = F.avg_pool2d(guides[coarsest], stride // coarsest)
        return of_left._replace(guides=guides), of_right

    def _of_both(self, left: Tensor, right: Tensor) -> tuple[Features, Features]:
        """What the backbone gives of each view; of the right one no guides."""
        if getattr(self.backbone, "paired", False):
            return cast(PairedBackbone, self.backbone)(left, right)
        matching, guides = self.backbone(torch.cat((left, right)))
        pairs = {stride: maps.chunk(2) for stride, maps in matching.items()}
        of_left, of_right = ({stride: pair[i] for stride, pair in pairs.items()} for i in (0, 1))
        return Features(of_left, {stride: maps.chunk(2)[0] for stride, maps in guides.items()}), Features(of_right, {})
