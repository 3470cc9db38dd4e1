import pytest
import timm
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import ConfigError, DeepAggregation
from stereokit.backbones.deep_aggregation import UpAggregation

SMALL = (3, 4, 5, 6, 7, 8, 9)


@pytest.mark.parametrize("finest", [2, 8, 32])
def test_features_are_what_the_info_says(finest):
    backbone = DeepAggregation(channels=SMALL, finest=finest).eval()
    features = backbone(torch.rand(2, 3, 64, 128))
    widths = {stride: width for stride, width in zip((2, 4, 8, 16, 32, 64), SMALL[1:], strict=True) if stride >= finest}
    assert backbone.info.matching_channels == backbone.info.guide_channels == widths
    for maps in features:
        assert {s: tuple(m.shape) for s, m in maps.items()} == {s: (2, c, 64 // s, 128 // s) for s, c in widths.items()}


def test_it_is_of_the_published_size():
    with torch.device("meta"):
        # less the outer projections of trees of depth 2, which nothing reads
        assert sum(p.numel() for p in DeepAggregation().parameters()) == 34_288_176 - 41_728


def test_the_trunk_is_dla_34():
    torch.manual_seed(0)
    ours = DeepAggregation().eval()
    theirs = timm.create_model("dla34", features_only=True).eval()
    state = ours.state_dict()
    for key, value in theirs.state_dict().items():
        part, _, rest = key.partition(".")
        place = {"base_layer": "stem.0", "level0": "stem.1"}.get(part) or f"levels.{int(part[5:]) - 1}"
        value.copy_(state[f"{place}.{rest}"])
    images, x, maps = torch.rand(1, 3, 64, 64), None, []
    with torch.inference_mode():
        x = ours.stem(images)
        for level in ours.levels:
            x = level(x)
            maps.append(x)
        for given, expected in zip(maps, theirs(images)[-5:], strict=False):
            assert_close(given, expected)


def test_the_coarsest_map_is_as_it_comes():
    backbone = DeepAggregation(channels=SMALL).eval()
    seen = []
    backbone.levels[-1].register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    assert_close(backbone(torch.rand(1, 3, 64, 64)).matching[64], seen[0])


def test_maps_are_merged_from_fine_to_coarse():
    aggregation = UpAggregation((2, 2, 3)).eval()
    maps = [torch.randn(1, 2, 4, 6), torch.randn(1, 2, 2, 3), torch.randn(1, 3, 2, 3)]
    assert [isinstance(project, nn.Identity) for project in aggregation.project] == [True, False]
    first = aggregation.merge[0](torch.cat((maps[0], aggregation.up[0](maps[1])), dim=1))
    second = aggregation.merge[1](torch.cat((first, aggregation.up[1](aggregation.project[1](maps[2]))), dim=1))
    assert_close(aggregation(maps), [first, second])


@pytest.mark.parametrize("arguments", [{"channels": (1, 2)}, {"finest": 64}, {"finest": 3}])
def test_what_can_not_be_is_refused(arguments):
    with pytest.raises(ConfigError, match=next(iter(arguments))):
        DeepAggregation(**arguments)
