import pytest
import torch
from torch import nn

from stereokit import ConfigError, StereoOutput
from stereokit.backends.eager import TorchBackend


class Product(nn.Module):
    """A matrix product, which autocast computes in half precision."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Conv2d(3, 1, 1)
        self.seen = None

    def forward(self, left, right):
        maps = self.layer(left)
        self.seen = maps.dtype, torch.is_inference_mode_enabled(), self.training
        return StereoOutput(maps[:, 0])


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_it_computes_in_the_precision_and_returns_float32(precision):
    network = Product().train()
    backend = TorchBackend(network, torch.device("cpu"), precision)
    estimate = backend(torch.rand(2, 3, 32, 40), torch.rand(2, 3, 32, 40))
    assert network.seen == (getattr(torch, precision), True, False)
    assert estimate.disparity.shape == (2, 32, 40)
    assert estimate.disparity.dtype == "float32"
    assert estimate.confidence is None
    assert backend.precision == precision


def test_other_precisions_are_refused():
    with pytest.raises(ConfigError, match="computes in float32, bfloat16, float16; got precision='int8'"):
        TorchBackend(Product(), torch.device("cpu"), "int8")
