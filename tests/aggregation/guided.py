"""What every aggregation owes its neighbours, whatever it is made of."""

import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, AdditiveGuidance, NeighborhoodAggregation

GUIDANCES = [None, GCE, AdditiveGuidance, NeighborhoodAggregation]


def guides_of(aggregation, size, *, stride, batch=1, dtype=torch.float32):
    """Noise for every guide that the aggregation reads; `size` is that of the volume, at `stride`."""
    height, width = size
    return {
        s: torch.randn(batch, channels, height * stride // s, width * stride // s, dtype=dtype)
        for s, channels in aggregation.guide_channels.items()
    }


def channels_at(*strides):
    """Another number of channels at each stride, so that a mix-up shows."""
    return {stride: 3 + i for i, stride in enumerate(strides)}


def assert_guides_matter(aggregation, volume, guides):
    """Gradients reach every guide, and the volume."""
    volume = volume.clone().requires_grad_()
    guides = {s: g.clone().requires_grad_() for s, g in guides.items()}
    sum(logits.square().sum() for logits in aggregation(volume, guides)).backward()
    assert volume.grad.any()
    assert all(g.grad.any() for g in guides.values())


def assert_gradients_are_right(aggregation, volume, guides):
    strides = list(guides)

    def run(volume, *maps):
        return aggregation(volume, dict(zip(strides, maps, strict=True)))

    inputs = [x.double().requires_grad_() for x in (volume, *guides.values())]
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True)


def with_running_statistics(aggregation):
    """Training mode as the aggregation sees it, while its norms stay in eval mode."""
    aggregation.eval()
    aggregation.training = True
    return aggregation


def assert_the_second_pair_is_residual(aggregation, volume):
    """Where its own output is zero, the first hourglass gets what the first pair gives."""
    nn.init.zeros_(aggregation.eval().pair1[1][1].weight)
    entered = []
    aggregation.hourglass1.register_forward_pre_hook(lambda _, inputs: entered.append(inputs[0]))
    aggregation(volume, {})
    assert_close(entered[0], aggregation.pair0(volume))
