import pytest
import torch

from stereokit import GCE, AdditiveGuidance, InputError
from stereokit.guidance.neighborhood import NeighborhoodAggregation


@pytest.mark.parametrize("block", [GCE, AdditiveGuidance, NeighborhoodAggregation])
@pytest.mark.parametrize(
    ("volume", "guide"),
    [
        ((1, 4, 3, 5, 6), (1, 5, 5, 6)),
        ((1, 3, 3, 5, 6), (1, 4, 5, 6)),
        # these would be stretched
        ((1, 3, 3, 5, 6), (1, 5, 1, 6)),
        ((1, 3, 3, 5, 6), (1, 5, 5, 1)),
        ((2, 3, 3, 5, 6), (1, 5, 5, 6)),
        ((3, 3, 5, 6), (1, 5, 5, 6)),
        ((1, 3, 3, 5, 6), (5, 5, 6)),
    ],
)
def test_a_volume_and_a_guide_that_do_not_meet_are_refused(block, volume, guide):
    with pytest.raises(InputError, match=r"\(B, 3, D, H, W\) and a guide \(B, 5, H, W\)") as caught:
        block(5, 3)(torch.rand(volume), torch.rand(guide))
    assert str(volume) in str(caught.value)
    assert str(guide) in str(caught.value)
