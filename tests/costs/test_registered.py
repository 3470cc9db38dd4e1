import pytest
import torch
from torch.testing import assert_close

from stereokit import COSTS

ARGUMENTS = {
    "groupwise_correlation": {"groups": 2},
    "combined": {"parts": ["concatenation", {"name": "groupwise_correlation", "groups": 2}]},
}

WARPS_NOT: set[str] = set()


@pytest.mark.parametrize("name", COSTS.names())
def test_what_a_cost_says_of_itself_is_what_it_does(name):
    cost = COSTS.build(name, {"in_channels": 8, "planes": 3, **ARGUMENTS.get(name, {})}).double().eval()
    left, right = torch.rand(2, 1, 8, 4, 12, dtype=torch.float64)
    volume = cost(left, right)
    assert volume.shape == (1, cost.out_channels, 3, 4, 12)
    candidates = torch.arange(3.0, dtype=torch.float64).reshape(1, 3, 1, 1).expand(1, 3, 4, 12)
    # builders give candidates of each pixel to costs that warp
    assert getattr(cost, "warps", False) == (name not in WARPS_NOT)
    if name not in WARPS_NOT:
        assert_close(cost(left, right, candidates), volume)
