import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit.costs import (
    CorrelationVolume,
    GroupwiseCorrelationVolume,
    correlation_volume,
    groupwise_correlation_volume,
)
from stereokit.costs.correlation import EPS
from stereokit.errors import ConfigError, InputError
from tests.strategies import feature_pairs, randn, seeds


def cosine_loop(left, right, levels):
    batch, _, height, width = left.shape
    volume = left.new_zeros(batch, 1, levels, height, width)
    for b in range(batch):
        for d in range(levels):
            for y in range(height):
                for x in range(d, width):
                    one, other = left[b, :, y, x], right[b, :, y, x - d]
                    volume[b, 0, d, y, x] = one @ other / (one.norm().clamp(min=EPS) * other.norm().clamp(min=EPS))
    return volume


def groupwise_loop(left, right, levels, groups):
    batch, channels, height, width = left.shape
    size = channels // groups
    volume = left.new_zeros(batch, groups, levels, height, width)
    for g in range(groups):
        members = slice(g * size, (g + 1) * size)
        for d in range(levels):
            for x in range(d, width):
                volume[:, g, d, :, x] = (left[:, members, :, x] * right[:, members, :, x - d]).mean(1)
    return volume


@given(feature_pairs())
def test_correlation_equals_the_loop(pair):
    assert_close(correlation_volume(*pair), cosine_loop(*pair))


@given(feature_pairs(dtype=torch.float32), st.sampled_from([1e-6, 1e-3, 1, 1e4, 1e15]), st.sampled_from([1e-3, 1, 50]))
def test_correlation_lies_in_its_range(pair, left_scale, right_scale):
    left, right, levels = pair
    volume = correlation_volume(left_scale * left, right_scale * right, levels)
    assert volume.abs().max() <= 1 + 1e-6


@given(feature_pairs())
def test_a_pixel_correlates_with_itself_by_one(pair):
    left, _, levels = pair
    volume = correlation_volume(left, left, levels)
    # features shorter than the eps count as that long, so that those of an empty image are finite
    length = left.norm(dim=1, keepdim=True)
    assert_close(volume[:, :, 0], (length / length.clamp(min=EPS)) ** 2)


@given(feature_pairs(min_channels=3), st.floats(0.1, 100), st.floats(0.1, 100))
def test_correlation_ignores_brightness(pair, left_gain, right_gain):
    left, right, levels = pair
    expected = correlation_volume(left, right, levels)
    # features smaller than the eps are what keeps zero images finite; stay above it
    left_norm, right_norm = left.norm(dim=1, keepdim=True), right.norm(dim=1, keepdim=True)
    scaled = correlation_volume(left / left_norm * left_gain, right / right_norm * right_gain, levels)
    assert_close(scaled, expected)


@given(seeds, st.integers(0, 5), st.integers(6, 12))
def test_the_peak_is_at_the_true_shift(seed, shift, levels):
    scene = randn(seed, 1, 8, 3, 30)
    left, right = scene[..., :24], scene[..., shift : shift + 24]
    volume = correlation_volume(left, right, levels)[:, 0]
    assert (volume.argmax(1)[..., shift:] == shift).all()
    assert_close(volume[:, shift, :, shift:], torch.ones(1, 3, 24 - shift))


@given(feature_pairs(), st.integers(1, 3))
def test_nothing_is_seen_left_of_the_right_image(pair, groups):
    left, right, levels = pair
    left, right = left.repeat(1, groups, 1, 1), right.repeat(1, groups, 1, 1)
    for volume in (
        correlation_volume(left, right, levels),
        groupwise_correlation_volume(left, right, levels, groups),
        groupwise_correlation_volume(left, right, levels, groups, normalise=True),
    ):
        for d in range(levels):
            assert (volume[:, :, d, :, :d] == 0).all()


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.7, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_constant_images_are_finite(value, dtype):
    if value > torch.finfo(dtype).max:
        value = 3e4
    left, right = (torch.full((1, 4, 2, 6), value, dtype=dtype, requires_grad=True) for _ in range(2))
    volume = correlation_volume(left, right, 3)
    volume.float().sum().backward()
    for x in (volume, left.grad, right.grad):
        assert x.isfinite().all()
    assert volume.dtype == dtype
    seen = torch.arange(6) >= torch.arange(3)[:, None]
    expected = seen.float() if value > 1e-3 else torch.zeros(3, 6)
    assert_close(volume.detach()[0, 0, :, 0].float(), expected, atol=1e-2, rtol=0)


def test_norms_do_not_overflow_in_half_precision():
    features = torch.full((1, 256, 1, 2), 3e4, dtype=torch.float16)
    assert_close(correlation_volume(features, features, 1).float(), torch.ones(1, 1, 1, 1, 2), atol=1e-2, rtol=0)


def test_levels_beyond_the_width_are_empty():
    volume = correlation_volume(torch.rand(1, 3, 2, 4), torch.rand(1, 3, 2, 4), 20)
    assert volume.shape == (1, 1, 20, 2, 4)
    assert (volume[:, :, 4:] == 0).all()


@given(feature_pairs(), st.integers(1, 3))
def test_groupwise_equals_the_loop(pair, groups):
    left, right, levels = pair
    left = torch.cat([left, *(left.flip(1) * g for g in range(1, groups))], 1)
    right = torch.cat([right, *(right * g for g in range(1, groups))], 1)
    volume = groupwise_correlation_volume(left, right, levels, groups)
    assert_close(volume, groupwise_loop(left, right, levels, groups))


@given(feature_pairs())
def test_groupwise_is_cosine_by_groups(pair):
    left, right, levels = pair
    volume = groupwise_correlation_volume(
        torch.cat((left, right), 1), torch.cat((right, right), 1), levels, 2, normalise=True
    )
    assert_close(volume[:, :1], correlation_volume(left, right, levels))
    assert_close(volume[:, 1:], correlation_volume(right, right, levels))


@pytest.mark.parametrize("groups", [0, -1, 3, 5])
def test_groups_that_do_not_divide_are_refused(groups):
    features = torch.rand(1, 4, 2, 5)
    with pytest.raises(InputError, match=f"{groups} groups do not divide 4 channels"):
        groupwise_correlation_volume(features, features, 2, groups)
    with pytest.raises(ConfigError, match=rf"groups={groups} does not divide the 4 .*use \[1, 2, 4\]"):
        GroupwiseCorrelationVolume(in_channels=4, planes=2, groups=groups)


@pytest.mark.parametrize("channels", [8, 24])
def test_groups_are_given_by_their_size_too(channels):
    cost = GroupwiseCorrelationVolume(in_channels=channels, planes=2, group_channels=4)
    assert cost.groups == cost.out_channels == channels // 4
    with pytest.raises(ConfigError, match=r"group_channels=5 does not divide the 8 .*use \[1, 2, 4, 8\]"):
        GroupwiseCorrelationVolume(in_channels=8, planes=2, group_channels=5)
    with pytest.raises(ConfigError, match="give one of groups=2 and group_channels=4"):
        GroupwiseCorrelationVolume(in_channels=8, planes=2, groups=2, group_channels=4)


@given(feature_pairs(), st.integers(1, 3), st.booleans())
def test_candidates_of_whole_pixels_are_the_planes(pair, groups, normalise):
    left, right, levels = pair
    left, right = left.repeat(1, groups, 1, 1), right.repeat(1, groups, 1, 1)
    planes = torch.arange(levels, dtype=left.dtype).reshape(1, -1, 1, 1)
    planes = planes.expand(len(left), -1, *left.shape[-2:])
    assert_close(
        groupwise_correlation_volume(left, right, planes, groups, normalise=normalise),
        groupwise_correlation_volume(left, right, levels, groups, normalise=normalise),
    )


def test_gradients_are_right():
    left, right = torch.randn(2, 1, 4, 2, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: correlation_volume(a, b, 3), (left, right))
    for normalise in (False, True):
        assert torch.autograd.gradcheck(
            lambda a, b, n=normalise: groupwise_correlation_volume(a, b, 3, 2, normalise=n), (left, right)
        )


@pytest.mark.parametrize(
    ("module", "function"),
    [
        (CorrelationVolume(in_channels=4, planes=3), lambda a, b: correlation_volume(a, b, 3)),
        (
            GroupwiseCorrelationVolume(in_channels=4, planes=3, groups=2),
            lambda a, b: groupwise_correlation_volume(a, b, 3, 2),
        ),
        (
            GroupwiseCorrelationVolume(in_channels=4, planes=3, groups=2, normalise=True),
            lambda a, b: groupwise_correlation_volume(a, b, 3, 2, normalise=True),
        ),
    ],
)
def test_modules_are_their_functions(module, function):
    left, right = torch.randn(2, 2, 4, 2, 7)
    volume = module(left, right)
    assert_close(volume, function(left, right))
    assert volume.shape[1:3] == (module.out_channels, module.planes)
    assert not list(module.parameters())


@pytest.mark.parametrize(
    "module",
    [
        CorrelationVolume(in_channels=4, planes=3, projection=(6, 5)),
        GroupwiseCorrelationVolume(in_channels=4, planes=3, groups=5, projection=(6, 5)),
    ],
)
def test_modules_compare_projected_features(module):
    left, right = torch.randn(2, 2, 4, 2, 7)
    module.eval()
    a, b = module.projection(left, right)
    assert a.shape == b.shape == (2, 5, 2, 7)
    raw = type(module)(in_channels=5, planes=3, **({"groups": 5} if module.out_channels == 5 else {}))
    assert_close(module(left, right), raw(a, b))
