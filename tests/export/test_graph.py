import pytest
import torch
from torch import nn

from stereokit import ConfigError, InputError, build_model
from stereokit.export.graph import ExportGraph, naming_block, trace
from tests.export.networks import Tiny


class Branching(nn.Module):
    def forward(self, x):
        return x * 2 if x.sum() > 0 else x


class Failing(nn.Module):
    def forward(self, x):
        raise RuntimeError("first line\nsecond line")


@pytest.mark.parametrize("block", [Branching(), Failing()])
def test_a_block_that_can_not_be_traced_is_named_on_one_line(block, capfd):
    model = build_model("coex", max_disparity=64).eval()
    model.aggregation.stem = nn.Sequential(model.aggregation.stem, block)
    with pytest.raises(
        ConfigError, match=r"^the block aggregation\.stem\.1 of the network can't be exported: "
    ) as error:
        trace(model, (64, 96))
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""


def test_an_error_outside_the_network_names_no_block():
    with pytest.raises(ConfigError, match=r"^the network can't be exported: lost"), naming_block(ExportGraph(Tiny())):
        raise RuntimeError("lost")


def test_too_small_a_size_is_refused():
    with pytest.raises(InputError, match="40 x 31 pixels; at least 32 x 32"):
        trace(Tiny(), (31, 40))


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (64, 96), (200, 129)])
def test_a_graph_of_any_size_gives_what_the_network_gives(tiny, size):
    program = trace(tiny, None).module()
    left, right = torch.rand(2, 1, 3, *size)
    with torch.no_grad():
        disparity, confidence = program(left, right)
        expected = tiny(left, right)
    torch.testing.assert_close(disparity, expected.disparity)
    torch.testing.assert_close(confidence, expected.confidence)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet"])
def test_the_networks_are_traced_for_any_size(name):
    model = build_model(name, max_disparity=64).eval()
    program = trace(model, None).module()
    for size in ((32, 32), (33, 47), (64, 256), (257, 65)):
        left, right = torch.rand(2, 1, 3, *size)
        with torch.no_grad():
            torch.testing.assert_close(program(left, right)[0], model(left, right).disparity)
