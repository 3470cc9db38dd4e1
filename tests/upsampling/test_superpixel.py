import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, InputError, SuperpixelUpsampler
from stereokit.upsampling.superpixel import superpixel_upsample
from tests.strategies import disparities, randn, seeds

PADDINGS = ["replicate", "zeros"]
scales = st.sampled_from([1, 2, 3, 4])


def some_weights(disparity, scale, seed):
    batch, height, width = disparity.shape
    return randn(seed, batch, 9, height * scale, width * scale, dtype=disparity.dtype).softmax(1)


def loop(disparity, weights, padding):
    batch, height, width = disparity.shape
    scale = weights.shape[-1] // width
    out = disparity.new_zeros(batch, height * scale, width * scale)
    for y in range(height * scale):
        for x in range(width * scale):
            for k in range(9):
                cy, cx = y // scale + k // 3 - 1, x // scale + k % 3 - 1
                inside = 0 <= cy < height and 0 <= cx < width
                if inside or padding == "replicate":
                    value = disparity[:, min(max(cy, 0), height - 1), min(max(cx, 0), width - 1)]
                    out[:, y, x] += weights[:, k, y, x] * value
    return out


@given(disparities(), scales, seeds, st.sampled_from(PADDINGS))
def test_it_equals_the_loop(disparity, scale, seed, padding):
    weights = some_weights(disparity, scale, seed)
    assert_close(superpixel_upsample(disparity, weights, padding=padding), loop(disparity, weights, padding))


@given(disparities(), scales, seeds)
def test_constants_stay_constant(disparity, scale, seed):
    constant = torch.full_like(disparity, 7.5)
    result = superpixel_upsample(constant, some_weights(disparity, scale, seed))
    assert_close(result, torch.full_like(result, 7.5))


@given(disparities(), scales, seeds)
def test_the_result_lies_within_its_neighbours(disparity, scale, seed):
    padded = F.pad(disparity[:, None], (1, 1, 1, 1), mode="replicate")
    highest, lowest = F.max_pool2d(padded, 3, stride=1), -F.max_pool2d(-padded, 3, stride=1)
    result = superpixel_upsample(disparity, some_weights(disparity, scale, seed))
    assert (result <= F.interpolate(highest, scale_factor=scale)[:, 0] + 1e-9).all()
    assert (result >= F.interpolate(lowest, scale_factor=scale)[:, 0] - 1e-9).all()


@given(disparities(), scales, st.sampled_from(PADDINGS))
def test_the_centre_alone_is_nearest_upsampling(disparity, scale, padding):
    weights = torch.zeros_like(some_weights(disparity, scale, 0))
    weights[:, 4] = 1
    expected = F.interpolate(disparity[:, None], scale_factor=scale, mode="nearest")[:, 0]
    assert_close(superpixel_upsample(disparity, weights, padding=padding), expected)


def test_zero_padding_pulls_the_border_to_zero():
    weights = torch.full((1, 9, 12, 12), 1 / 9)
    result = superpixel_upsample(torch.full((1, 3, 3), 9.0), weights, padding="zeros")
    assert_close(result[0, :, 0], torch.tensor([4.0, 6.0, 4.0]).repeat_interleave(4))
    assert_close(result[0, 4:8, 4:8], torch.full((4, 4), 9.0))


@pytest.mark.parametrize("padding", PADDINGS)
def test_gradients_are_right(padding):
    disparity = torch.rand(1, 2, 3, dtype=torch.float64, requires_grad=True)
    weights = torch.rand(1, 9, 4, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, w: superpixel_upsample(d, w, padding=padding), (disparity, weights))


@pytest.mark.parametrize(
    ("disparity", "weights"),
    [
        ((1, 2, 3), (1, 8, 4, 6)),
        ((1, 2, 3), (1, 9, 4, 7)),
        ((1, 2, 3), (1, 9, 5, 6)),
        ((1, 2, 3), (1, 9, 1, 1)),
        ((1, 1, 2, 3), (1, 9, 4, 6)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(disparity, weights):
    with pytest.raises(InputError) as error:
        superpixel_upsample(torch.rand(disparity), torch.rand(weights))
    assert str(disparity) in str(error.value)
    assert str(weights) in str(error.value)


def test_unknown_padding_is_refused():
    with pytest.raises(InputError, match="'reflect' is unknown; use 'replicate' or 'zeros'"):
        superpixel_upsample(torch.rand(1, 2, 3), torch.rand(1, 9, 4, 6), padding="reflect")
    with pytest.raises(ConfigError, match="'reflect' is unknown; use 'replicate' or 'zeros'"):
        SuperpixelUpsampler(scale=4, guide_channels={4: 8}, padding="reflect")


def guides_for(upsampler, height=3, width=5, batch=1):
    s = upsampler.scale
    return {
        stride: torch.randn(batch, channels, height * s // stride, width * s // stride)
        for stride, channels in upsampler.guide_channels.items()
    }


@pytest.mark.parametrize(
    ("scale", "guides", "read"),
    [
        (2, {2: 6}, {2: 6}),
        (4, {2: 5, 4: 6, 8: 7}, {2: 5, 4: 6}),
        (4, {4: 6}, {4: 6}),
        (8, {2: 4, 4: 5, 8: 6, 16: 7}, {2: 4, 4: 5, 8: 6}),
        (8, {2: 4, 8: 6}, {2: 4, 8: 6}),
    ],
)
def test_the_guides_at_hand_are_read(scale, guides, read):
    upsampler = SuperpixelUpsampler(scale=scale, guide_channels=guides).eval()
    assert upsampler.guide_channels == read
    maps = {s: g.requires_grad_() for s, g in guides_for(upsampler, batch=2).items()}
    weights = upsampler.weights(maps)
    assert weights.shape == (2, 9, 3 * scale, 5 * scale)
    assert_close(weights.sum(1), torch.ones(2, 3 * scale, 5 * scale))
    weights[:, 0].sum().backward()
    assert all(g.grad.abs().sum() > 0 for g in maps.values())


@pytest.mark.parametrize("padding", PADDINGS)
def test_the_module_is_its_function(padding):
    upsampler = SuperpixelUpsampler(scale=4, guide_channels={2: 5, 4: 6}, padding=padding).eval()
    guides = guides_for(upsampler)
    disparity = torch.rand(1, 3, 5)
    expected = superpixel_upsample(disparity, upsampler.weights(guides), padding=padding)
    assert_close(upsampler(disparity, guides), expected)
    assert upsampler.learned
    assert upsampler.domain == "disparity"


def test_the_edge_is_replicated_unless_told_otherwise():
    upsampler = SuperpixelUpsampler(scale=4, guide_channels={4: 6}).eval()
    result = upsampler(torch.full((1, 3, 5), 3.0), guides_for(upsampler))
    assert_close(result, torch.full((1, 12, 20), 3.0))


def test_weights_are_never_in_half_precision():
    upsampler = SuperpixelUpsampler(scale=4, guide_channels={4: 6}).eval()
    with torch.autocast("cpu", torch.bfloat16):
        weights = upsampler.weights(guides_for(upsampler))
    assert weights.dtype == torch.float32
    assert_close(weights.sum(1), torch.ones(1, 12, 20))


@pytest.mark.parametrize("scale", [0, 1, 3, 6])
def test_the_stride_is_a_power_of_two(scale):
    with pytest.raises(ConfigError, match=rf"2, 4, 8, \.\.\.; the disparity is to grow by {scale}"):
        SuperpixelUpsampler(scale=scale, guide_channels={scale: 8})


@pytest.mark.parametrize(("guides", "listed"), [({2: 8, 8: 8}, "2, 8"), ({}, "none")])
def test_the_guide_at_the_stride_is_needed(guides, listed):
    with pytest.raises(ConfigError, match=f"stride 4 wants a guide of that stride; there are guides at {listed}"):
        SuperpixelUpsampler(scale=4, guide_channels=guides)


@pytest.mark.parametrize("padding", ["replicate", "zeros"])
@pytest.mark.parametrize("needed", [(True, True), (True, False), (False, True)])
def test_gradients_are_those_of_the_formula(padding, needed):
    disparity = randn(0, 2, 3, 4, dtype=torch.float64).requires_grad_(needed[0])
    weights = randn(1, 2, 9, 6, 8, dtype=torch.float64).requires_grad_(needed[1])
    assert torch.autograd.gradcheck(lambda d, w: superpixel_upsample(d, w, padding=padding), (disparity, weights))


def test_only_the_weights_are_kept_for_the_backward_pass():
    disparity, weights = torch.rand(1, 8, 8, requires_grad=True), torch.rand(1, 9, 32, 32, requires_grad=True)
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.untyped_storage()) or t, lambda t: t):
        superpixel_upsample(disparity, weights)
    assert weights.untyped_storage().data_ptr() in {storage.data_ptr() for storage in kept}
    assert sum(storage.nbytes() for storage in kept) < 1.1 * weights.untyped_storage().nbytes()
