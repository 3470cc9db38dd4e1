"""Blocks in networks that did not bring them: (network, what is chosen otherwise, the loss among it)."""

import json

import pytest
import torch

from stereokit import build_model
from stereokit.losses import named_loss, stereo_loss

CDN = {"name": "with_offsets", "base": "hourglass"}

REFINED = [{"name": "edge_aware", "channels": 8, "dilations": [1, 2]}]

PYRAMID = {"name": "top_down_pyramid", "base": "spatial_pyramid"}
GWC = {"name": "gwc_hourglass", "channels": 8}

THIRDS = {"name": "bottleneck_pyramid", "scales": 1}
ADAPTIVE = {"name": "adaptive", "modules": 2, "deformable": 1}

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
    ("coex", {"guidance": "msca"}),
    ("psmnet", {"guidance": "msca", "guidance_at": "one"}),
    ("lightstereo_s", {"guidance": "gce"}),
    ("lightstereo_s", {"guidance": "neighborhood", "guidance_at": "one"}),
    ("lightstereo_s", {"guidance": "none", "top_k": 2}),
    ("coex", {"aggregation": "inverted_residual"}),
    ("psmnet", {"aggregation": "inverted_residual"}),
    ("gcnet", {"aggregation": "inverted_residual", "upsampler": "bilinear"}),
    ("coex", {"backbone": "feature_pyramid"}),
    ("psmnet", {"backbone": "feature_pyramid"}),
    ("lightstereo_s", {"backbone": "unet"}),
    ("coex", {"upsampler": "image_superpixel"}),
    ("psmnet", {"upsampler": "image_superpixel"}),
    ("lightstereo_s", {"upsampler": "superpixel"}),
    ("coex", {"upsampler": "convex"}),
    ("lightstereo_s", {"upsampler": "convex"}),
    ("lightstereo_s", {"aggregation": "hourglass"}),
    ("lightstereo_s", {"cost": "concatenation"}),
    ("gwcnet_g", {"candidates": "patch_match", "aggregation": "plain", "upsampler": "bilinear"}),
    ("psmnet", {"candidates": {"name": "patch_match", "particles": 14}, "upsampler": "bilinear"}),
    ("psmnet", {"backbone": {"name": "spatial_pyramid", "halvings": 3}, "stride": 8, "upsampler": "bilinear"}),
    ("coex", {"backbone": {"name": "spatial_pyramid", "halvings": 3}, "stride": 8, "upsampler": "bilinear"}),
    ("coex", {"aggregation": {"name": "level_path", "levels": [1, 2, 1], "skips": []}, "guidance_at": "full"}),
    ("psmnet", {"aggregation": {"name": "level_path", "filters": 2}}),
    ("psmnet", {"backbone": "level_path", "max_disparity": 48}),
    ("coex", {"backbone": "level_path", "max_disparity": 72, "upsampler": "bilinear"}),
    ("coex", {"guidance": "semi_global"}),
    ("psmnet", {"guidance": "semi_global", "guidance_at": "one"}),
    ("lightstereo_s", {"guidance": "semi_global", "guidance_at": "one"}),
    ("coex", {"regression": "local_guided"}),
    ("gwcnet_g", {"regression": "local_guided"}),
    ("coex", {"aggregation": {"name": "repeated_hourglass", "channels": [2, 3, 4]}}),
    ("psmnet", {"aggregation": {"name": "repeated_hourglass", "channels": [2, 3, 4], "passes": 1}}),
    ("coex", {"backbone": "double_hourglass", "upsampler": "bilinear", "max_disparity": 72}),
    ("psmnet", {"backbone": "double_hourglass", "guidance": "gce", "guidance_at": "full", "max_disparity": 48}),
    ("ganet_11", {"guidance": "gce", "regression": {"name": "top_k", "k": 2}, "max_disparity": 48}),
    ("ganet_deep", {"guidance": "none", "backbone": "level_path", "max_disparity": 48}),
    ("leastereo", {"guidance": "gce", "top_k": 2, "max_disparity": 48}),
    (
        "psmnet",
        {"coarse": [{"stride": 4, "cost": "correlation"}], "candidates": {"name": "most_probable", "planes": 8}},
    ),
    ("casstereo_gwc", {"candidates": {"name": "most_probable", "planes": 4}}),
    ("coex", {"aggregation": "attention_hourglass"}),
    ("psmnet", {"aggregation": "attention_hourglass", "guidance": "gce", "guidance_at": "one"}),
    ("coex", {"backbone": {"name": "unet", "stem_channels": [32, 48, 32]}}),
    ("psmnet", {"backbone": "embedding"}),
    ("gcnet", {"backbone": "embedding", "upsampler": "trilinear"}),
    ("psmnet", {"cost": {"name": "matching_network", "width": 8, "blocks": 1}}),
    ("coex", {"cost": {"name": "matching_network", "width": 8, "out_channels": 4, "blocks": 1}}),
    ("psmnet", {"aggregation": "shortcut_hourglass", "upsampler": "none", "max_disparity": 128}),
    ("coex", {"aggregation": "shortcut_hourglass", "upsampler": "none", "max_disparity": 128}),
    ("pdsnet", {"guidance": "gce", "guidance_at": "full", "max_disparity": 128}),
    ("coex", {"regression": "sub_pixel_map"}),
    ("psmnet", {"regression": "sub_pixel_map"}),
    ("psmnet", {"backbone": "separable_trunk", "stride": 4}),
    ("gcnet", {"backbone": "separable_trunk", "stride": 4, "upsampler": "trilinear"}),
    ("psmnet", {"cost": {"name": "interlaced", "reduction": [8, 4], "kernels": [4, 2], "channels": [4, 4]}}),
    ("coex", {"cost": {"name": "interlaced", "reduction": [8, 4], "kernels": [4, 2], "channels": [4, 4]}}),
    ("coex", {"aggregation": {"name": "separable_hourglass", "channels": 8}, "guidance_at": "one"}),
    ("psmnet", {"aggregation": {"name": "separable_hourglass", "dims": 2}, "guidance": "gce", "guidance_at": "full"}),
    ("gwcnet_g", {"aggregation": {"name": "separable_hourglass", "dims": 2}}),
    ("gcnet", {"aggregation": ADAPTIVE, "upsampler": "bilinear"}),
    ("coex", {"aggregation": ADAPTIVE, "guidance_at": "one"}),
    ("psmnet", {"aggregation": ADAPTIVE, "guidance": "gce", "guidance_at": "full"}),
    ("coex", {"refinements": ["warped"]}),
    ("psmnet", {"refinements": [{"name": "warped", "body": "hourglass"}]}),
    ("stereonet_8x", {"backbone": THIRDS, "refinements": REFINED, "max_disparity": 48}),
    ("psmnet", {"backbone": THIRDS, "max_disparity": 48}),
    (
        "stereonet_8x",
        {"backbone": THIRDS | {"name": "deformable_hourglass"}, "refinements": REFINED, "max_disparity": 48},
    ),
    ("psmnet", {"backbone": {"name": "deformable_hourglass", "scales": 1, "deformable": False}, "max_disparity": 48}),
    ("aanet", {"guidance": "gce", "top_k": 2, "max_disparity": 48}),
    ("aanet_plus", {"cost": {"name": "concatenation", "projection": [8]}, "max_disparity": 48}),
    # a loss of the distribution does not reach an upsampler behind it that learns
    ("coex", {"aggregation": CDN, "regression": "mode", "upsampler": "trilinear", "loss": "wasserstein"}),
    ("coex", {"aggregation": CDN, "upsampler": "bilinear", "loss": {"name": "wasserstein", "power": 2}}),
    ("gwcnet_g", {"aggregation": CDN | {"base": "gwc_hourglass"}, "regression": "mode", "loss": "wasserstein"}),
    ("casstereo_gwc", {"aggregation": CDN | {"base": "gwc_hourglass"}, "loss": "wasserstein"}),
    ("coex", {"upsampler": "bilinear", "loss": "wasserstein"}),
    ("psmnet", {"loss": {"name": "wasserstein", "neighbors": 0.2}}),
    ("coex", {"backbone": {"name": "deep_aggregation", "channels": [4, 4, 6, 6, 8, 8, 8], "finest": 4}}),
    ("psmnet", {"backbone": {"name": "deep_aggregation", "channels": [4, 4, 6, 6, 8, 8, 8], "finest": 4}}),
    ("coex", {"loss": "density", "upsampler": "bilinear"}),
    ("psmnet", {"loss": "density"}),
    ("coex", {"regression": "most_probable_pair"}),
    ("psmnet", {"regression": "most_probable_pair"}),
    ("coex", {"aggregation": {"name": "dilated_context", "channels": 8}, "guidance_at": "one"}),
    ("psmnet", {"aggregation": {"name": "dilated_context", "channels": 8}}),
    ("lightstereo_s", {"aggregation": {"name": "dilated_context", "channels": 8, "dilations": [1, 2]}}),
    ("lightstereo_s", {"aggregation": {"name": "bilateral", "branch": {"name": "inverted_residual"}}}),
    ("coex", {"aggregation": {"name": "bilateral", "branch": {"name": "hourglass", "channels": [2, 3, 4]}}}),
    ("psmnet", {"aggregation": {"name": "bilateral", "branch": GWC, "channels": 4}}),
    ("coex", {"guidance": "scaling"}),
    ("psmnet", {"guidance": {"name": "scaling", "reduction": 2}}),
    ("banet_2d", {"guidance": "msca", "top_k": 2}),
    ("banet_3d", {"cost": "groupwise_correlation", "upsampler": "convex"}),
    ("coex", {"loss": "stereo_focal"}),
    ("psmnet", {"loss": "stereo_focal"}),
    ("coex", {"aggregation": {"name": "with_confidence", "base": "hourglass"}, "loss": "stereo_focal"}),
    ("gwcnet_g", {"aggregation": {"name": "with_confidence", "base": "gwc_hourglass"}, "loss": "stereo_focal"}),
    ("coex", {"aggregation": {"name": "with_upsampling", "base": "hourglass"}, "upsampler": "none"}),
    ("psmnet", {"aggregation": {"name": "with_upsampling", "base": "stacked_hourglass"}, "upsampler": "none"}),
    ("acfnet", {"aggregation": CDN | {"base": "stacked_hourglass"}, "upsampler": "trilinear", "loss": "wasserstein"}),
    ("cdn_psmnet", {"regression": "soft_argmin", "guidance": "gce", "loss": "stereo_focal"}),
    ("coex", {"guidance": {"name": "affinity", "steps": 2}}),
    ("coex", {"guidance": {"name": "affinity", "dims": 3, "steps": 1}, "guidance_at": "one"}),
    ("psmnet", {"guidance": {"name": "affinity", "centre": "own"}, "guidance_at": "one"}),
    ("coex", {"aggregation": {"name": "with_propagation", "base": "hourglass", "steps": 2}}),
    ("gwcnet_g", {"aggregation": {"name": "with_propagation", "base": "gwc_hourglass", "steps": 2}}),
    ("coex", {"backbone": "affinity_pyramid"}),
    ("psmnet", {"backbone": "affinity_pyramid"}),
]


QUICK = ("coex", "lightstereo_s", "stereonet_8x")
"""Networks whose swaps are part of the quick run."""


@pytest.mark.parametrize(
    ("network", "overrides"),
    [pytest.param(*swap, marks=() if swap[0] in QUICK else pytest.mark.slow) for swap in SWAPS],
)
def test_a_block_works_in_another_network(network, overrides):
    choices = {"max_disparity": 64, "loss": "smooth_l1", **overrides}
    measure = named_loss(choices.pop("loss"))
    model = build_model(network, **choices)
    left, right = torch.rand(2, 2, 3, 64, 96)
    output = model(left, right)
    truth = torch.full_like(left[:, 0], 5.0)
    loss = stereo_loss(output, truth, auxiliary_weights=model.auxiliary_weights, loss=measure)
    loss.backward()
    assert loss.isfinite()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    assert all(p.grad.isfinite().all() for p in model.parameters())
    config = json.loads(json.dumps(model.config))
    assert build_model(config).config == config


@pytest.mark.slow
def test_lightstereo_takes_a_larger_encoder():
    model = build_model("lightstereo_l", backbone={"encoder": "efficientnetv2_rw_s"}, max_disparity=64).eval()
    assert model.backbone.info.guide_channels == {4: 48, 8: 64, 16: 160, 32: 272}
    with torch.inference_mode():
        assert model(*torch.rand(2, 1, 3, 64, 96)).disparity.isfinite().all()
