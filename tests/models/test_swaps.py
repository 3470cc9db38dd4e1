"""Blocks in networks that did not bring them: (network, what is chosen otherwise)."""

import pytest
import torch

from stereokit import build_model
from stereokit.losses import stereo_loss

PYRAMID = {"name": "top_down_pyramid", "base": "spatial_pyramid"}
GWC = {"name": "gwc_hourglass", "channels": 8}

SWAPS = [
    ("coex", {"aggregation": GWC, "guidance_at": "one"}),
    ("psmnet", {"aggregation": GWC, "guidance": "gce", "guidance_at": "full"}),
    ("psmnet", {"backbone": "gwc_trunk", "stride": 4}),
    ("gcnet", {"backbone": "gwc_trunk", "stride": 4, "upsampler": "trilinear"}),
    ("gwcnet_g", {"guidance": "gce", "top_k": 6}),
    ("gwcnet_g", {"cost": "correlation", "upsampler": "superpixel"}),
    ("psmnet", {"backbone": PYRAMID | {"smooth": False}}),
    ("gcnet", {"backbone": {"name": "top_down_pyramid", "base": "unet", "smooth": False}}),
    ("casstereo_gwc", {"guidance": "gce"}),
    (
        "psmnet",
        {
            "backbone": PYRAMID,
            "coarse": [{"stride": 4, "candidates": {"name": "uniform", "per_plane": 4}}],
            "candidates": {"name": "range"},
        },
    ),
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
