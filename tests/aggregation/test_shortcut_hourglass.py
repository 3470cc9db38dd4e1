from itertools import pairwise

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError, ShortcutHourglass
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(4, 8, 16, 32, 64)


def shortcut(planes=16, **arguments):
    return ShortcutHourglass(in_channels=3, planes=planes, channels=2, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = shortcut(guidance=guidance, guidance_at=guidance_at)
    assert aggregation.guide_channels == (GUIDES if guidance and guidance_at == "full" else {4: GUIDES[4]})
    volume, guides = torch.randn(1, 3, 16, 16, 32), guides_of(aggregation, (16, 32), stride=4)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (1, 32, 64, 128)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_nine_places():
    blocks = [m for m in shortcut(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    down = [(8, 4), (16, 8), (32, 16), (64, 32)]
    up = [(32, 16), (16, 8), (8, 4), (4, 2)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [(GUIDES[s], c) for s, c in ((4, 2), *down, *up)]


def test_the_shortcut_goes_down_beside_the_volume():
    aggregation, seen = shortcut(), []
    for down in aggregation.down:
        down.register_forward_hook(lambda _, inputs, output: seen.append((inputs, output)))
    guides = guides_of(aggregation, (16, 32), stride=4)
    aggregation(torch.randn(1, 3, 16, 16, 32), guides)
    assert_close(seen[0][0][0], aggregation.shortcut(guides[4]).unsqueeze(2))
    for (_, output), (inputs, _) in pairwise(seen):
        assert inputs[0] is output[0]
        assert inputs[1] is output[1]
    (given, x), (below, smooth) = seen[1]
    assert_close(below, aggregation.down[1].down(given + x))
    assert_close(smooth, aggregation.down[1].smooth(below))


def test_skips_are_added():
    up = shortcut().up[0]
    x, skip = torch.randn(1, 32, 2, 2, 3), torch.randn(1, 16, 4, 4, 6)
    assert_close(up(x, skip), up.smooth(up.up(x) + skip))


def test_it_is_of_the_published_size():
    aggregation = ShortcutHourglass(in_channels=8, planes=48, guide_channels={4: 64})
    own = nn.ModuleList(m for name, m in aggregation.named_children() if name != "shortcut")
    assert sum(p.numel() for p in own.parameters()) == 1_730_645


def test_gradients_are_right():
    aggregation = shortcut().double()
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 16, 16, 32), guides_of(aggregation, (16, 32), stride=4))


def test_it_wants_its_guide():
    with pytest.raises(ConfigError, match="stride 8 wants a guide of that stride; there are guides at 4"):
        ShortcutHourglass(in_channels=3, planes=16, stride=8, guide_channels={4: 6})
