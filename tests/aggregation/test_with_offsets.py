import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import AGGREGATIONS, GCE, ConfigError, WithOffsets, build_model
from tests.aggregation.guided import channels_at, guides_of

BASES = ["stacked_hourglass", "gwc_hourglass", "hourglass", "plain", "encoder_decoder", "attention_hourglass"]
BASES += ["level_path", "shortcut_hourglass", "repeated_hourglass", "separable_hourglass"]
SMALL = {
    "stacked_hourglass": {"channels": 2},
    "gwc_hourglass": {"channels": 2},
    "hourglass": {"channels": [2, 3, 4]},
    "plain": {"channels": 2},
    "encoder_decoder": {"channels": 2},
    "level_path": {"filters": 2},
    "repeated_hourglass": {"channels": [2, 3, 4]},
    "separable_hourglass": {"channels": 2},
}


OFFERED = {"in_channels": 4, "planes": 16, "guide_channels": {4: 3}}


def built(base):
    return WithOffsets(base={"name": base, **SMALL.get(base, {})}, **OFFERED)


@pytest.mark.parametrize("name", BASES)
def test_logits_are_those_of_the_base_and_offsets_have_weights_of_their_own(name):
    aggregation = built(name)
    volume, guides = torch.randn(2, 4, 16, 16, 32), {4: torch.randn(2, 3, 16, 32)}
    heads = aggregation(volume, guides)
    assert len(heads) == len(aggregation.loss_weights)
    sum((head.logits * head.offsets).sum() for head in heads).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in aggregation.parameters())
    # the same without offsets
    state = {k.replace(".logits.", "."): v for k, v in aggregation.base.state_dict().items() if ".offsets." not in k}
    plain = AGGREGATIONS.build(name, SMALL.get(name, {}), OFFERED)
    plain.load_state_dict(state)
    for head, expected in zip(aggregation.eval()(volume, guides), plain.eval()(volume, guides), strict=True):
        assert_close(head.logits, expected)
        assert head.offsets.shape == expected.shape
        assert (head.offsets - head.logits).abs().mean() > 0


def test_offsets_add_up_as_the_logits_do():
    aggregation = built("stacked_hourglass").train()
    seen = {}
    for number in (1, 2, 3):
        head = getattr(aggregation.base, f"head{number}").offsets
        head.register_forward_hook(lambda _module, _in, out, number=number: seen.update({number: out.squeeze(1)}))
    heads = aggregation(torch.randn(1, 4, 8, 8, 8), {})
    assert_close(heads[2].offsets, seen[1] + seen[2] + seen[3])


def test_guidance_goes_to_the_base():
    guides = channels_at(4, 8, 16)
    aggregation = WithOffsets(
        base={"name": "stacked_hourglass", "channels": 2},
        in_channels=3,
        planes=8,
        guide_channels=guides,
        guidance=GCE,
        guidance_at="full",
    )
    assert aggregation.guide_channels == guides
    assert aggregation(torch.randn(1, 3, 8, 8, 8), guides_of(aggregation, (8, 8), stride=4))[-1].offsets.shape[1] == 8


def test_heads_of_maps_are_refused():
    for base in ("inverted_residual", {"name": "separable_hourglass", "dims": 2}):
        with pytest.raises(ConfigError, match=r"'with_offsets' wants a base whose heads are 3D.*(inverted|separable)"):
            build_model("coex", aggregation={"name": "with_offsets", "base": base})
    with pytest.raises(ConfigError, match="unknown aggregation 'hourglas'"):
        build_model("coex", aggregation={"name": "with_offsets", "base": "hourglas"})


class Nearest(nn.Module):
    scale, domain, learned, guide_channels = 4, "disparity", False, {}

    def forward(self, x, guides):
        return x.repeat_interleave(4, 1).repeat_interleave(4, 2)


def test_offsets_move_the_estimate_within_its_bin():
    torch.manual_seed(0)
    model = build_model(
        "coex",
        aggregation={"name": "with_offsets", "base": "hourglass"},
        top_k=1,
        upsampler=Nearest(),
        max_disparity=64,
    )
    model.eval()
    images = torch.rand(2, 1, 3, 64, 96)
    raw = []
    model.aggregation.register_forward_hook(lambda _module, _in, out: raw.append(out[-1]))
    with torch.inference_mode():
        disparity = model.match(*images).disparity
    level = Nearest()(raw[0].logits.argmax(1), {})
    assert ((disparity >= 4 * level) & (disparity <= 4 * (level + 1))).all()
    assert (disparity % 4 > 0).any()
