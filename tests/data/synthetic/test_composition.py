import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data.synthetic import Composition, render_view
from stereokit.data.synthetic.shapes import Box, Ellipse, Lattice, Wire
from stereokit.errors import ConfigError


@given(
    seed=st.integers(0, 2**32 - 1), highest=st.sampled_from([8.0, 30.0, 128.0]), exponent=st.sampled_from([0.0, 2.0])
)
@settings(deadline=None, max_examples=40)
def test_disparity_stays_within_bounds(bank, seed, highest, exponent):
    composition = Composition(size=(48, 128), max_disparity=highest, range_exponent=exponent)
    scene = composition.scene(np.random.default_rng(seed), bank)
    for view in ("left", "right"):
        disparity = render_view(scene, view).disparity
        assert disparity.min() >= 0
        assert disparity.max() <= highest


def disparities(bank, count=40, **options):
    composition = Composition(size=(48, 96), max_disparity=32, **options)
    scenes = [composition.scene(np.random.default_rng(seed), bank) for seed in range(count)]
    return scenes, np.stack([render_view(scene, "left").disparity for scene in scenes])


def test_all_disparities_occur(bank):
    _, values = disparities(bank)
    share, _ = np.histogram(values, bins=8, range=(0, 32))
    assert share.min() / share.sum() > 0.02
    assert (values < 0.5).mean() > 0.01


def test_the_exponent_moves_things_away(bank):
    _, even = disparities(bank, disparity_exponent=0.6)
    _, far = disparities(bank, disparity_exponent=4.0)
    assert even.mean() > far.mean() + 1


def test_scenes_may_have_ranges_of_their_own(bank):
    def largest(**options):
        return disparities(bank, objects=(8, 8), **options)[1].max(axis=(1, 2))

    assert largest().min() > 16
    own = largest(range_exponent=1.0)
    assert own.min() < 8 < 24 < own.max() <= 32
    assert largest(range_exponent=3.0).mean() < own.mean() - 4


def test_number_and_kind_of_things(bank):
    def things(scenes):
        return [layer.shape for scene in scenes for layer in scene.layers if layer.shape is not None]

    thin, _ = disparities(bank, thin=1.0, objects=(8, 8), count=10)
    kinds = {type(shape) for shape in things(thin)}
    assert kinds == {Box, Wire, Lattice, Ellipse}
    solid, _ = disparities(bank, thin=0.0, objects=(8, 8), count=10)
    assert not {Wire, Lattice} & {type(shape) for shape in things(solid)}
    assert len(things(solid)) >= 80
    empty, values = disparities(bank, objects=(0, 0), count=10)
    assert len(things(empty)) < 20
    assert np.isfinite(values).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (16, 512)}, "at least 32 x 32 pixels, got size 16 x 512"),
        ({"max_disparity": 600}, "from 4 to the width 512, got 600"),
        ({"disparity_exponent": 0}, "disparity_exponent must be positive"),
        ({"range_exponent": -1.0}, "range_exponent must be at least 0, got -1"),
        ({"thin": 1.5}, "thin must be a part from 0 to 1, got 1.5"),
        ({"glossy": -0.1}, "glossy must be a part from 0 to 1, got -0.1"),
        ({"objects": (5, 2)}, "fewest and the most"),
    ],
)
def test_wrong_settings(options, message):
    with pytest.raises(ConfigError, match=message):
        Composition(**options)


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_light_leaves_the_geometry(bank, seed):
    plain, lit = (
        Composition(size=(48, 128), range_exponent=1.0, **light).scene(np.random.default_rng(seed), bank)
        for light in ({}, {"alike": 0.5, "shaded": 0.5, "glossy": 0.5})
    )
    assert [(layer.surface, layer.shape) for layer in lit.layers] == [
        (layer.surface, layer.shape) for layer in plain.layers
    ]
    assert not any(layer.shade or layer.reflection for layer in plain.layers)


def test_a_reflection_lies_behind_its_surface(bank):
    columns, rows = np.arange(96, dtype=np.float32)[None], np.arange(48, dtype=np.float32)[:, None]
    for seed in range(60):
        for layer in Composition(size=(48, 96), glossy=1).scene(np.random.default_rng(seed), bank).layers:
            if layer.reflection is None:
                continue
            for view in ("left", "right"):
                _, disparity, outside = layer.seen(columns.repeat(48, 0), rows, view)
                seen = disparity if outside is None else disparity[outside < 0]
                assert layer.reflection.disparity <= max(seen.min(initial=np.inf), 0) + 1e-3


def test_all_but_the_sky_may_be_lit_or_alike(bank):
    changed = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        plain = Composition(size=(48, 96)).scene(np.random.default_rng(seed), bank)
        lit = Composition(size=(48, 96), alike=1, shaded=1, glossy=1).scene(rng, bank)
        palettes = [layer.texture.palette.tobytes() for layer in plain.layers]
        for before, layer in zip(plain.layers, lit.layers, strict=True):
            sky = layer.shape is None and layer.surface.slope == (0, 0) and layer.surface.disparity < 1
            assert (layer.shade is None) == (layer.reflection is None) == sky
            assert layer.texture.palette.tobytes() in palettes
            assert layer.texture.ground == before.texture.ground
            if sky:
                np.testing.assert_array_equal(layer.texture.palette, before.texture.palette)
            else:
                assert 0 <= layer.reflection.disparity <= max(0.9 * layer.surface.disparity, 0)
                assert 0 < layer.reflection.strength <= 0.5
                changed += layer.texture.palette.tobytes() != before.texture.palette.tobytes()
    assert changed > 100


def test_shades_are_grey_and_never_black(bank):
    rng = np.random.default_rng(0)
    lows = []
    for _ in range(50):
        palette = bank.shade(rng).palette
        assert (palette == palette[:, :1]).all()
        assert (np.diff(palette[:, 0].astype(int)) >= 0).all()
        assert palette[-1, 0] == 255
        lows.append(palette[0, 0])
    assert min(lows) >= 60
    assert max(lows) - min(lows) > 60
