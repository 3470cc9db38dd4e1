import pytest
import torch
from torch import nn

from stereokit import ConfigError, StereoOutput, build_model
from stereokit.backends.eager import TorchBackend

SEEN = []


class Product(nn.Module):
    """A matrix product, which autocast computes in half precision."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Conv2d(3, 1, 1)

    def forward(self, left, right):
        maps = self.layer(left)
        SEEN[:] = [maps.dtype, torch.is_inference_mode_enabled(), self.training]
        return StereoOutput(maps[:, 0])


@pytest.mark.filterwarnings("ignore:this CPU has no instructions")
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_it_computes_in_the_precision_and_returns_float32(precision):
    network = Product().train()
    backend = TorchBackend(network, torch.device("cpu"), precision)
    estimate = backend(torch.rand(2, 3, 32, 40), torch.rand(2, 3, 32, 40))
    assert [getattr(torch, precision), True, False] == SEEN
    assert estimate.disparity.shape == (2, 32, 40)
    assert estimate.disparity.dtype == "float32"
    assert estimate.confidence is None
    assert backend.precision == precision


def test_other_precisions_are_refused():
    with pytest.raises(ConfigError, match="computes in float32, bfloat16, float16; got precision='int8'"):
        TorchBackend(Product(), torch.device("cpu"), "int8")


@pytest.mark.parametrize("change", ["step", "load", "assign", "replace", "add"])
def test_changed_weights_are_seen(change):
    network = Product()
    backend = TorchBackend(network, torch.device("cpu"))
    images = torch.rand(2, 1, 3, 32, 40)
    before = backend(*images).disparity
    assert backend.prepare(*images) == 0
    other = Product()
    if change == "step":
        with torch.no_grad():
            network.layer.weight.add_(1)
    elif change in ("load", "assign"):
        network.load_state_dict(other.state_dict(), assign=change == "assign")
    elif change == "add":
        network.layer.register_parameter("bias", None)
    else:
        network.layer = other.layer
    backend.prepare(*images)
    after = backend(*images).disparity
    with torch.inference_mode():
        expected = network(*images).disparity.numpy()
    assert abs(after - expected).max() < 1e-5 < abs(after - before).max()


def test_the_network_itself_is_left_as_it_is():
    network = build_model("coex", max_disparity=64)
    blocks, state = list(network.modules()), {name: t.clone() for name, t in network.state_dict().items()}
    TorchBackend(network, torch.device("cpu"))(*torch.rand(2, 1, 3, 32, 64))
    assert list(network.modules()) == blocks
    assert all(torch.equal(tensor, state[name]) for name, tensor in network.state_dict().items())
