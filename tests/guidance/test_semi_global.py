import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import InputError, SemiGlobalGuidance
from stereokit.guidance import semi_global_aggregate

STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Down, up, right, left."""


def plainly(volume, weights):
    """Pixel by pixel, as the equation has it; differentiable."""
    batch, channels, planes, height, width = volume.shape
    weights = weights.reshape(batch, 4, channels, 5, height, width)
    weights = weights / weights.abs().sum(3, keepdim=True)
    results = []
    for direction, (down, right) in enumerate(STEPS):
        found = {}
        for y in range(height) if down >= 0 else reversed(range(height)):
            for x in range(width) if right >= 0 else reversed(range(width)):
                here, w = volume[..., y, x], weights[:, direction, :, :, y, x]
                before = found.get((y - down, x - right))
                columns = []
                for d in range(planes):
                    own = here[..., d]
                    terms = [own] * 5
                    if before is not None:
                        terms[1] = before[..., d]
                        terms[2] = before[..., d - 1] if d > 0 else own
                        terms[3] = before[..., d + 1] if d + 1 < planes else own
                        terms[4] = before.amax(-1)
                    columns.append(sum(w[..., i] * term for i, term in enumerate(terms)))
                found[y, x] = torch.stack(columns, dim=-1)
        rows = [torch.stack([found[y, x] for x in range(width)], dim=-1) for y in range(height)]
        results.append(torch.stack(rows, dim=-2))
    return torch.stack(results).amax(0)


def example(size, seed=0, batch=1, channels=2, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    planes, height, width = size
    volume = torch.randn(batch, channels, planes, height, width, generator=generator, dtype=dtype)
    weights = torch.randn(batch, 20 * channels, height, width, generator=generator, dtype=dtype)
    return volume, weights


SIZES = st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(1, 4))


# the plain loop is slow
@settings(max_examples=15)
@given(SIZES, st.integers(1, 2), st.integers(0, 99))
def test_it_is_the_equation_with_its_gradient(size, batch, seed):
    volume, weights = (x.requires_grad_() for x in example(size, seed, batch))
    given_, expected = semi_global_aggregate(volume, weights), plainly(volume, weights)
    assert_close(given_, expected)
    g = torch.randn_like(given_)
    assert_close(torch.autograd.grad(given_, (volume, weights), g), torch.autograd.grad(expected, (volume, weights), g))


def test_gradients_are_right():
    inputs = [x.requires_grad_() for x in example((3, 4, 3))]
    assert torch.autograd.gradcheck(semi_global_aggregate, inputs, fast_mode=True)


@pytest.mark.parametrize("wanted", ["volume", "weights", "neither"])
def test_a_gradient_may_be_wanted_of_one_alone(wanted):
    volume, weights = example((3, 4, 5))
    volume.requires_grad_(wanted == "volume")
    weights.requires_grad_(wanted == "weights")
    result = semi_global_aggregate(volume, weights)
    assert result.requires_grad == (wanted != "neither")
    if wanted != "neither":
        result.sum().backward()
    assert (volume.grad is not None) == (wanted == "volume")
    assert (weights.grad is not None) == (wanted == "weights")


@given(SIZES, st.integers(0, 99), st.floats(0.1, 9))
def test_weights_count_by_their_share(size, seed, factor):
    volume, weights = example(size, seed)
    assert_close(semi_global_aggregate(volume, factor * weights), semi_global_aggregate(volume, weights))


@given(SIZES, st.integers(0, 99))
def test_nothing_grows(size, seed):
    volume, weights = example(size, seed)
    assert semi_global_aggregate(volume, weights).abs().max() <= volume.abs().max() + 1e-9


@given(SIZES, st.integers(0, 99))
def test_a_flipped_image_is_aggregated_alike(size, seed):
    """Up and down, left and right change their places."""
    volume, weights = example(size, seed)
    down, up, right, left = weights.chunk(4, dim=1)
    flipped = torch.cat((up, down, right, left), dim=1).flip(-2)
    assert_close(semi_global_aggregate(volume.flip(-2), flipped).flip(-2), semi_global_aggregate(volume, weights))
    turned = torch.cat((right, left, down, up), dim=1).transpose(-1, -2)
    transposed = semi_global_aggregate(volume.transpose(-1, -2), turned).transpose(-1, -2)
    assert_close(transposed, semi_global_aggregate(volume, weights))


def test_no_scan_is_kept_for_the_backward_pass():
    volume, weights = (x.requires_grad_() for x in example((8, 6, 10), channels=3))
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
        semi_global_aggregate(volume, weights)
    voxels = [x.numel() * x.element_size() for x in kept if x.numel() == volume.numel()]
    assert sorted(voxels) == [volume.numel(), 8 * volume.numel()]


def test_half_precision_keeps_its_type():
    volume, weights = example((4, 5, 6), dtype=torch.float32)
    result = semi_global_aggregate(volume.bfloat16(), weights)
    assert result.dtype == torch.bfloat16
    assert_close(result.float(), semi_global_aggregate(volume, weights), rtol=0.05, atol=0.1)


def test_the_block_keeps_the_volume_where_its_convolution_is_silent():
    block = SemiGlobalGuidance(guide_channels=3, volume_channels=2).eval()
    torch.nn.init.zeros_(block.refine[1].weight)
    volume = torch.randn(1, 2, 4, 5, 6)
    assert_close(block(volume, torch.randn(1, 3, 5, 6)), volume.relu())


def test_the_block_reads_its_guide():
    block = SemiGlobalGuidance(guide_channels=3, volume_channels=2)
    volume, guide = torch.randn(1, 2, 4, 5, 6).requires_grad_(), torch.randn(1, 3, 5, 6).requires_grad_()
    block(volume, guide).square().sum().backward()
    assert volume.grad.any()
    assert guide.grad.any()
    assert all(p.grad is not None for p in block.parameters())


def test_the_blocks_have_the_published_size():
    for channels, published in ((32, 27_776), (48, 62_400)):
        block = SemiGlobalGuidance(guide_channels=channels, volume_channels=channels)
        assert sum(p.numel() for p in block.parameters()) - block.weights.weight.numel() == published


@pytest.mark.slow
def test_a_graph_of_it_agrees():
    class Block(torch.nn.Module):
        def forward(self, volume, weights):
            return semi_global_aggregate(volume, weights)

    inputs = example((4, 5, 6), dtype=torch.float32)
    with torch.no_grad():
        program = torch.export.export(Block(), inputs)
    assert_close(program.module()(*inputs), Block()(*inputs))


def test_weights_of_another_number_are_refused():
    with pytest.raises(InputError, match="20 weights for each of the 2 channels"):
        semi_global_aggregate(torch.rand(1, 2, 3, 4, 5), torch.rand(1, 20, 4, 5))
