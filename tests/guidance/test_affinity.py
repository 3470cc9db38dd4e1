import pytest
import torch
from torch.testing import assert_close

from stereokit import AffinityGuidance, ConfigError, InputError
from stereokit.layers import affinity_propagate


@pytest.mark.parametrize("dims", [2, 3])
@pytest.mark.parametrize("centre", ["input", "own"])
def test_it_spreads_the_volume_by_weights_of_the_image(dims, centre):
    block = AffinityGuidance(5, 3, dims=dims, steps=2, centre=centre).double()
    volume = torch.randn(2, 3, 4, 5, 6, dtype=torch.float64)
    guide = torch.randn(2, 5, 5, 6, dtype=torch.float64)
    given, affinity = block(volume, guide), block.affinity(guide)
    if dims == 3:
        assert_close(given, affinity_propagate(volume, affinity.unsqueeze(2), steps=2, centre=centre))
        return
    for d in range(4):
        assert_close(given[:, :, d], affinity_propagate(volume[:, :, d], affinity, steps=2, centre=centre))


@pytest.mark.parametrize("dims", [2, 3])
def test_gradients_are_right(dims):
    block = AffinityGuidance(3, 2, dims=dims, steps=2).double()
    volume = torch.randn(2, 2, 2, 2, 2, dtype=torch.float64, requires_grad=True)
    guide = torch.randn(2, 3, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(block, (volume, guide))


def test_what_makes_no_sense_is_refused():
    for arguments in ({"dims": 4}, {"steps": 0}, {"centre": "mine"}):
        with pytest.raises(ConfigError, match=next(iter(arguments))):
            AffinityGuidance(3, 2, **arguments)
    with pytest.raises(InputError, match="wants a volume"):
        AffinityGuidance(5, 3)(torch.rand(1, 3, 2, 4, 4), torch.rand(1, 6, 4, 4))
