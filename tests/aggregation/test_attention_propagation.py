import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit.aggregation import AttentionPropagation, propagate_attention
from tests.strategies import randn, seeds


def sampled(row, x):
    """A row at a place between pixels, 0 outside."""
    low = int(torch.floor(x))
    share = x - low
    inside = [row[i] if 0 <= i < len(row) else 0 * row[0] for i in (low, low + 1)]
    return (1 - share) * inside[0] + share * inside[1]


def loop(logits, left, right, bias, slope):
    batch, levels, height, width = logits.shape
    out = torch.empty_like(logits)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                scores, others = [], []
                for dy, dx in ((-1, -1), (0, 0), (1, 1), (1, -1), (-1, 1)):
                    v, u = min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)
                    p = logits[b, :, v, u].softmax(0)
                    mean = sum(d * p[d] for d in range(levels))
                    variance = sum(p[d] * (d - mean) ** 2 for d in range(levels))
                    partner = torch.stack([sampled(row, x - mean) for row in right[b, :, y]])
                    similar = (left[b, :, y, x] * partner).mean()
                    scores.append(similar * torch.sigmoid(bias + slope * variance))
                    others.append(logits[b, :, v, u])
                weights = torch.stack(scores).softmax(0)
                out[b, :, y, x] = sum(w * a for w, a in zip(weights, others, strict=True))
    return out


@settings(max_examples=15)
@given(seeds, st.integers(1, 2), st.integers(2, 5), st.floats(-2, 2), st.floats(-1, 1))
def test_it_equals_the_loop(seed, batch, levels, bias, slope):
    logits = randn(seed, batch, levels, 3, 4, dtype=torch.float64)
    left, right = 3 * randn(seed + 1, 2, batch, 3, 3, 4, dtype=torch.float64)
    numbers = [torch.tensor([x], dtype=torch.float64) for x in (bias, slope)]
    given = propagate_attention(logits, left, right, bias=numbers[0], slope=numbers[1])
    assert_close(given, loop(logits, left, right, *numbers))


@given(seeds)
def test_it_stays_between_the_neighbours(seed):
    logits = randn(seed, 1, 4, 5, 6)
    given = AttentionPropagation()(logits, *randn(seed + 1, 2, 1, 3, 5, 6))
    assert given.max() <= logits.max() + 1e-5
    assert given.min() >= logits.min() - 1e-5
    alike = torch.full_like(logits, 2.0)
    assert_close(AttentionPropagation()(alike, *randn(seed + 1, 2, 1, 3, 5, 6)), alike)


def test_gradients_are_right():
    block = AttentionPropagation().double()

    def run(logits, left, right, bias, slope):
        return propagate_attention(logits, left, right, bias=bias, slope=slope)

    maps = [x.requires_grad_() for x in (*torch.randn(2, 1, 3, 3, 4, dtype=torch.float64),)]
    logits = torch.randn(1, 4, 3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(run, (logits, *maps, *block.parameters()), fast_mode=True)
