"""Where the top k of a network's candidates may be these or those."""

import copy
from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor, nn

from stereokit.contracts import Guides
from stereokit.layers import bilinear_upsample
from stereokit.model import StereoModel
from stereokit.regression import TopKSoftArgmin

__all__ = ["tied_pixels"]

ROUNDING = 1e-5
"""Of the largest logit: kernels that add in another order are nearer than that."""


def tied_pixels(model: nn.Module, left: Tensor, right: Tensor) -> Tensor:
    """The pixels whose disparity rests on a tie: rounding decides which of two candidates is among the top k.

    Logits that were enlarged by interpolation tie exactly at both ends, where the border is repeated.

    Args:
        model: in eval mode; one without a top-k regression of the library's has no ties.
        left: (B, 3, H, W).
        right: likewise.

    Returns:
        (B, H, W), bool.

    >>> from stereokit import build_model
    >>> tied_pixels(build_model("gcnet", max_disparity=32).eval(), *torch.rand(2, 1, 3, 32, 40)).any().item()
    False
    """
    if not isinstance(model, StereoModel) or not isinstance(model.regression, TopKSoftArgmin):
        return torch.zeros(left.shape[0], *left.shape[-2:], dtype=torch.bool)
    # the network upsamples the ties as it does the disparity; refinements, which are smooth, leave them where they are
    twin = copy.deepcopy(model)
    twin.regression = Tie(model.regression.test_k)
    twin.refinements = nn.ModuleList([Enlarged()] if len(model.refinements) else [])
    with torch.inference_mode():
        return twin(left, right).disparity > 0


class Tie(nn.Module):
    """In place of the regression: 1 where the k-th largest logit and the next are the same but for rounding, else 0.

    Args:
        k: candidates kept.
    """

    def __init__(self, k: int) -> None:
        super().__init__()
        self.k = self.min_levels = k

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        if self.k == logits.shape[1]:
            return torch.zeros_like(logits[:, 0])
        last, next_best = logits.topk(self.k + 1, dim=1).values[:, -2:].unbind(1)
        return (last - next_best <= ROUNDING * logits.abs().amax()).to(logits.dtype)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The same twice."""
        tie = self(logits)
        return tie, tie


class Enlarged(nn.Module):
    """In place of refinements: what comes, at full resolution."""

    stride = 1
    guide_channels: Mapping[int, int] = MappingProxyType({})
    loss_weight = 0.0

    def forward(self, disparity: Tensor, left: Tensor, right: Tensor, guides: Guides) -> Tensor:
        """(B, h, w) to (B, H, W)."""
        return bilinear_upsample(disparity, left.shape[-1] // disparity.shape[-1])
