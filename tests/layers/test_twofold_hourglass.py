import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit.layers import DeformableConvolution, TwofoldHourglass
from tests.strategies import randn, seeds


@settings(max_examples=10)
@given(st.integers(1, 3), st.integers(1, 3), st.booleans(), seeds)
def test_it_keeps_the_shape_and_reads_the_latest_map_of_each_scale(rows, columns, deformable, seed):
    block = TwofoldHourglass((2, 4, 6), deformable=deformable).eval().double()
    fine = randn(seed, 1, 2, 4 * rows, 4 * columns, dtype=torch.float64)
    # once more, by name
    half = block.down1[0](fine)
    bottom = block.down1[1](half)
    half = block.up1[0](bottom, half)
    full = block.up1[1](half, fine)
    half = block.down2[0](full, half)
    bottom = block.down2[1](half, bottom)
    half = block.up2[0](bottom, half)
    assert_close(block(fine), block.up2[1](half, full))
    assert block(fine).shape == fine.shape
    assert block.multiple == 4


def test_two_scales_are_deformable():
    found = [
        name for name, m in TwofoldHourglass(deformable=True).named_modules() if isinstance(m, DeformableConvolution)
    ]
    assert found == ["down1.2", "down1.3", "down2.2.merge", "down2.3.merge"]
    assert not any(isinstance(m, DeformableConvolution) for m in TwofoldHourglass().modules())
