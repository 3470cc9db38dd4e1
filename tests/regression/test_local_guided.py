import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError, LocalGuidedSoftArgmin, SoftArgmin
from stereokit.regression import local_guided, local_guided_aggregate


def plainly(volume, weights):
    """Pixel by pixel, as the equation has it; differentiable."""
    planes, height, width = volume.shape[1:]
    weights = weights / weights.abs().sum(1, keepdim=True)
    parts = [[[0.0] * width for _ in range(height)] for _ in range(planes)]
    for d in range(planes):
        for y in range(height):
            for x in range(width):
                for j in range(75):
                    k, r, c = d + j // 25 - 1, y + j % 25 // 5 - 2, x + j % 5 - 2
                    inside = 0 <= k < planes and 0 <= r < height and 0 <= c < width
                    value = volume[:, k, r, c] if inside else volume[:, d, y, x]
                    parts[d][y][x] = parts[d][y][x] + weights[:, j, y, x] * value
    rows = [[torch.stack(row, dim=-1) for row in plane] for plane in parts]
    return torch.stack([torch.stack(plane, dim=-2) for plane in rows], dim=1)


def example(size, seed=0, batch=1):
    generator = torch.Generator().manual_seed(seed)
    volume = torch.randn(batch, *size, generator=generator, dtype=torch.float64)
    return volume, torch.randn(batch, 75, *size[1:], generator=generator, dtype=torch.float64)


SIZES = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 3))


# the plain loop is slow
@settings(max_examples=5)
@given(SIZES, st.integers(0, 99), st.sampled_from([1, 8, 2**18]))
def test_it_is_the_equation_with_its_gradient(size, seed, band):
    volume, weights = (x.requires_grad_() for x in example(size, seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local_guided, "BAND", band)
        found = local_guided_aggregate(volume, weights)
        g = torch.randn_like(found)
        gradients = torch.autograd.grad(found, (volume, weights), g)
    expected = plainly(volume, weights)
    assert_close(found, expected)
    assert_close(gradients, torch.autograd.grad(expected, (volume, weights), g))


def test_gradients_are_right():
    inputs = [x.requires_grad_() for x in example((3, 4, 3), batch=2)]
    assert torch.autograd.gradcheck(local_guided_aggregate, inputs, fast_mode=True)


@given(SIZES, st.integers(0, 99))
def test_equal_values_stay_by_positive_weights_and_nothing_grows(size, seed):
    volume, weights = example(size, seed)
    assert local_guided_aggregate(volume, weights).abs().max() <= volume.abs().max() + 1e-9
    same = torch.full_like(volume, 3.0)
    assert_close(local_guided_aggregate(same, weights.abs()), same)


def test_nothing_but_volume_and_weights_is_kept():
    volume, weights = (x.requires_grad_() for x in example((40, 12, 20)))
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
        local_guided_aggregate(volume, weights)
    assert sum(x.numel() == volume.numel() for x in kept) == 1
    assert max(x.numel() for x in kept) <= 78 * 12 * 20 + volume.numel()


def centred(regression):
    """Weights that leave everything as it is."""
    for part in (regression.of_logits, regression.of_probability):
        torch.nn.init.zeros_(part[1].weight)
        part[1].bias = torch.nn.Parameter(torch.nn.functional.one_hot(torch.tensor(37), 75).float())
    return regression


@given(st.integers(0, 9))
def test_filters_that_keep_everything_leave_a_soft_argmin(seed):
    torch.manual_seed(seed)
    regression = centred(LocalGuidedSoftArgmin(guide_channels={1: 3})).eval()
    logits, guides = 3 * torch.randn(2, 9, 4, 5), {1: torch.rand(2, 3, 4, 5)}
    assert_close(regression(logits, guides=guides), SoftArgmin()(logits))
    candidates = torch.arange(9) * 2.5
    for given_, expected in zip(
        regression.with_confidence(logits, candidates, guides=guides),
        SoftArgmin().with_confidence(logits, candidates),
        strict=True,
    ):
        assert_close(given_, expected)


def test_without_guides_it_is_a_soft_argmin():
    logits = torch.randn(1, 9, 4, 5)
    assert_close(LocalGuidedSoftArgmin(guide_channels={1: 3})(logits), SoftArgmin()(logits))


def test_both_filters_are_read_and_twice_each():
    regression = LocalGuidedSoftArgmin(guide_channels={4: 5}, stride=4).eval()
    assert regression.guide_channels == {4: 5}
    logits, guide = torch.randn(1, 9, 4, 5), torch.randn(1, 5, 4, 5)
    first, second = regression.of_logits(guide), regression.of_probability(guide)
    twice = local_guided_aggregate(local_guided_aggregate(logits, first), first).softmax(1)
    p = local_guided_aggregate(local_guided_aggregate(twice, second), second)
    expected = (p * torch.arange(9).reshape(-1, 1, 1)).sum(1) / p.abs().sum(1)
    assert_close(regression(logits, guides={4: guide}), expected)
    estimate, confidence = regression.with_confidence(logits, guides={4: guide})
    assert_close(estimate, expected)
    assert ((confidence >= 0) & (confidence <= 1)).all()


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match=r"weights \(B, 75, H, W\)"):
        local_guided_aggregate(torch.rand(1, 3, 4, 5), torch.rand(1, 25, 4, 5))
    with pytest.raises(ConfigError, match="at stride 2 wants a guide there; there are guides at 1, 4"):
        LocalGuidedSoftArgmin(guide_channels={1: 3, 4: 8}, stride=2)
