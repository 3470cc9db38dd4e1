"""Blocks in networks that did not bring them: (network, what is chosen otherwise)."""

import pytest
import torch

from stereokit import build_model
from stereokit.losses import stereo_loss

REFINED = [{"name": "edge_aware", "channels": 8, "dilations": [1, 2]}]

SWAPS = [
    ("coex", {"refinements": REFINED}),
    ("gcnet", {"refinements": REFINED}),
    ("psmnet", {"refinements": REFINED * 2}),
    ("coex", {"aggregation": {"name": "plain", "channels": 8}, "guidance_at": "one"}),
    ("psmnet", {"aggregation": {"name": "plain", "channels": 8}, "guidance": "gce", "guidance_at": "full"}),
    ("psmnet", {"backbone": {"name": "strided", "channels": 8, "halvings": 2}}),
    ("gcnet", {"backbone": {"name": "strided", "channels": 8, "halvings": 1}, "guidance": "gce"}),
    ("stereonet_8x", {"guidance": "gce", "top_k": 2}),
    ("stereonet_8x", {"upsampler": "bilinear", "cost": "correlation"}),
    ("stereonet_16x", {"upsampler": "bilinear", "refinements": []}),
]


@pytest.mark.parametrize(("network", "overrides"), SWAPS)
def test_a_block_fits_another_network(network, overrides):
    model = build_model(network, max_disparity=64, **overrides)
    assert build_model(model.config).config == model.config
    left, right = torch.rand(2, 2, 3, 64, 96)
    output = model(left, right)
    truth = torch.full_like(left[:, 0], 5.0)
    stereo_loss(output, truth, auxiliary_weights=model.auxiliary_weights).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
    with torch.inference_mode():
        disparity = model.eval()(left, right).disparity
    assert disparity.shape == (2, 64, 96)
    assert disparity.isfinite().all()
