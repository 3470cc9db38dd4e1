import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, NeighborhoodAggregation
from stereokit.guidance.neighborhood import neighborhood_sum
from tests.strategies import randn, seeds

windows = st.sampled_from([1, 3, 5])


@st.composite
def inputs(draw):
    batch, height, width = draw(st.integers(1, 2)), draw(st.integers(1, 4)), draw(st.integers(1, 4))
    volume = randn(draw(seeds), batch, 2, draw(st.integers(1, 3)), height, width, dtype=torch.float64)
    return volume, randn(draw(seeds), batch, 3, height, width, dtype=torch.float64)


def block_of(window, **arguments):
    torch.manual_seed(1)
    return NeighborhoodAggregation(3, 2, window=window, **arguments).double()


def neighbours(y, x, window, height, width):
    """Positions in the window around a pixel, in row-major order, each with whether it is inside the image."""
    for j in range(window * window):
        ny, nx = y + j // window - window // 2, x + j % window - window // 2
        yield j, ny, nx, 0 <= ny < height and 0 <= nx < width


def graph_weights(block, guide):
    """The edges one by one, as the paper writes them: the MLP sees both features and the encoded step between them."""
    batch, _, height, width = guide.shape
    window = block.window
    first = torch.cat(
        (block.from_centre.weight[:, :, 0, 0], block.from_neighbor.weight[:, :, 0, 0], block.from_position.weight), 1
    )
    last = block.edge[1]
    weights = guide.new_zeros(batch, window * window, block.volume_channels, height, width)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                edges = {}
                for j, ny, nx, inside in neighbours(y, x, window, height, width):
                    if inside:
                        step = guide.new_tensor([y - ny, x - nx]) / max(1, window // 2)
                        both = torch.cat((guide[b, :, y, x], guide[b, :, ny, nx], block.position(step)))
                        hidden = F.leaky_relu(first @ both + block.from_centre.bias, 0.01)
                        edges[j] = last.weight[:, :, 0, 0] @ hidden + last.bias
                total = sum(e.exp() for e in edges.values())
                for j, edge in edges.items():
                    weights[b, j, :, y, x] = edge.exp() / total
    return weights


def graph_sum(volume, weights):
    height, width = volume.shape[-2:]
    window = round(weights.shape[1] ** 0.5)
    out = torch.zeros_like(volume)
    for y in range(height):
        for x in range(width):
            for j, ny, nx, inside in neighbours(y, x, window, height, width):
                if inside:
                    out[..., y, x] += weights[:, j, :, None, y, x] * volume[..., ny, nx]
    return out


@given(inputs(), windows, seeds)
def test_the_sum_equals_the_loop(drawn, window, seed):
    volume, _ = drawn
    batch, channels, _, height, width = volume.shape
    weights = randn(seed, batch, window**2, channels, height, width, dtype=volume.dtype)
    assert_close(neighborhood_sum(volume, weights), graph_sum(volume, weights))


@given(inputs(), windows)
@settings(max_examples=25)
def test_the_block_equals_the_graph(drawn, window):
    volume, guide = drawn
    block = block_of(window)
    expected_weights = graph_weights(block, guide)
    assert_close(block.weights(guide), expected_weights)
    message = graph_sum(volume, expected_weights)
    mixed = torch.einsum("oc,bcdhw->bodhw", block.keep.weight[..., 0, 0, 0], volume)
    mixed = mixed + torch.einsum("oc,bcdhw->bodhw", block.take_in.weight[..., 0, 0, 0], message)
    mixed = mixed + block.take_in.bias.reshape(-1, 1, 1, 1)
    assert_close(block(volume, guide), torch.where(mixed > 0, mixed, 0.01 * mixed))


@given(inputs(), windows)
@settings(max_examples=50)
def test_weights_sum_to_one_inside_the_image_and_are_zero_outside(drawn, window):
    _, guide = drawn
    weights = block_of(window).weights(guide)
    batch, _, channels, height, width = weights.shape
    assert_close(weights.sum(1), torch.ones(batch, channels, height, width, dtype=weights.dtype))
    for y in range(height):
        for x in range(width):
            for j, _, _, inside in neighbours(y, x, window, height, width):
                assert ((weights[:, j, :, y, x] > 0) == inside).all()


@given(inputs(), windows)
@settings(max_examples=50)
def test_constants_stay_constant_up_to_the_border(drawn, window):
    volume, guide = drawn
    constant = torch.full_like(volume, 3.0)
    assert_close(neighborhood_sum(constant, block_of(window).weights(guide)), constant)


def test_weights_are_shared_over_disparity():
    volume, guide = torch.randn(1, 2, 3, 4, 5), torch.randn(1, 3, 4, 5)
    block = block_of(3).float()
    together = block(volume, guide)
    for d in range(3):
        assert_close(together[:, :, d : d + 1], block(volume[:, :, d : d + 1], guide))


def test_gradients_reach_volume_guide_and_every_weight():
    volume = torch.randn(1, 2, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    guide = torch.randn(1, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    block = block_of(3)
    block(volume, guide).square().sum().backward()
    assert (volume.grad != 0).all()
    assert (guide.grad != 0).all()
    assert [name for name, p in block.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_gradients_are_right():
    volume = torch.randn(1, 2, 2, 2, 3, dtype=torch.float64, requires_grad=True)
    guide = torch.randn(1, 3, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(block_of(3), (volume, guide))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_finite(dtype):
    block = block_of(3).to(dtype)
    weights = block.weights(100 * torch.randn(1, 3, 4, 5).to(dtype))
    assert weights.dtype == dtype
    assert weights.isfinite().all()


def test_offsets_are_no_weights():
    assert block_of(3).state_dict().keys() == dict(block_of(3).named_parameters()).keys()


def test_one_feature_is_enough():
    block = NeighborhoodAggregation(1, 2, position_channels=1)
    assert block(torch.rand(1, 2, 3, 4, 5), torch.rand(1, 1, 4, 5)).shape == (1, 2, 3, 4, 5)


@pytest.mark.parametrize("window", [0, 2, -1, 4])
def test_a_window_without_a_centre_is_refused(window):
    with pytest.raises(ConfigError, match=f"window={window} has no centre"):
        NeighborhoodAggregation(3, 2, window=window)
