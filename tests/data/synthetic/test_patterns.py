import numpy as np
import pytest

from stereokit.data.synthetic.patterns import PATTERNS, TILE, draw_tiles, noise


@pytest.mark.parametrize("kind", PATTERNS)
def test_tiles_repeat_without_a_seam(kind):
    field = PATTERNS[kind](np.random.default_rng(5))
    assert field.shape == (TILE, TILE)
    assert np.isfinite(field).all()
    spread = field.std()
    for axis in (0, 1):
        within = np.abs(np.diff(field, axis=axis)).mean(axis=1 - axis)
        seam = np.abs(np.take(field, 0, axis=axis) - np.take(field, -1, axis=axis)).mean()
        assert seam <= within.max() + 0.02 * spread


def test_tiles_are_drawn_anew_from_each_seed():
    first, again, other = (draw_tiles(np.random.default_rng(seed), 3) for seed in (1, 1, 2))
    for number in range(3):
        np.testing.assert_array_equal(first[number], again[number])
        assert (first[number] != other[number]).mean() > 0.3
        assert first[number].min() == 0
        assert first[number].max() == 255


def test_the_exponent_softens_noise():
    steps = [np.abs(np.diff(noise(np.random.default_rng(0), exponent=e))).mean() for e in (0.0, 1.0, 2.0)]
    assert steps[0] > 1.5 * steps[1] > 1.5 * 1.5 * steps[2]
    assert noise(np.random.default_rng(0), exponent=1.0).std() == pytest.approx(1)
    along = noise(np.random.default_rng(0), exponent=1.5, stretch=10)
    assert np.abs(np.diff(along, axis=1)).mean() > 2 * np.abs(np.diff(along, axis=0)).mean()
