"""What every aggregation owes its neighbours, whatever it is made of."""

import torch

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
