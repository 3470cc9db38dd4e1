"""What is BANet's own."""

import torch
from torch.testing import assert_close

from stereokit import build_model


def test_images_are_seen_in_0_to_255():
    model = build_model("banet_2d", max_disparity=32)
    seen = []
    model.backbone.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    images = torch.randint(0, 256, (1, 3, 32, 64), dtype=torch.uint8)
    model.eval()(images, images)
    assert_close(seen[0], images.float().expand(2, -1, -1, -1), rtol=0, atol=1e-3)


def test_guidance_acts_between_convolutions():
    """CoEx's own acts behind them."""
    early, late = (
        build_model("coex", max_disparity=32, aggregation={"guide_early": guide_early}).eval()
        for guide_early in (True, False)
    )
    volume = torch.randn(1, 1, 8, 8, 8)
    guides = {s: torch.randn(1, c, 32 // s, 32 // s) for s, c in early.aggregation.guide_channels.items()}
    down = early.aggregation.down1
    x = torch.randn(1, 8, 8, 8, 8)
    assert_close(down(x, guides), down.convs[1](down.guidance(down.convs[0](x), guides)))
    up = early.aggregation.up2
    coarse, skip = torch.randn(1, 32, 2, 2, 2), torch.randn(1, 16, 4, 4, 4)
    merged = up.merge(torch.cat((up.up(coarse), skip), dim=1))
    assert_close(up(coarse, skip, guides), up.convs(up.guidance(merged, guides)))
    assert early.aggregation(volume, guides)[-1].shape == late.aggregation(volume, guides)[-1].shape
    # ahead of the stem it is the volume's channels that are scaled
    assert early.aggregation.stem_guidance.block.volume_channels == 1
    assert late.aggregation.stem_guidance.block.volume_channels == 8
