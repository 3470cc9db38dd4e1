from dataclasses import replace

import numpy as np
import pytest

from stereokit.data.augmentation import flip_and_swap
from stereokit.data.synthetic import SyntheticScenes
from stereokit.data.synthetic.composition import Composition
from stereokit.data.synthetic.patterns import PATTERNS
from stereokit.data.synthetic.render import render_view
from stereokit.data.synthetic.scene import Layer, Reflection, Scene
from stereokit.data.synthetic.shapes import Box
from stereokit.data.synthetic.surfaces import Surface, Wave
from stereokit.errors import InputError
from tests.data.augmentation.pairs import errors

SMOOTH = {
    "plane": Surface((60.0, 30.0), 12.0, (0.2, -0.1)),
    "cylinder": Surface((60.0, 30.0), 12.0, (0.05, 0.0), (-0.002, 0.002), 60.0),
    "waves": Surface((60.0, 30.0), 12.0, (0.0, 0.1), waves=(Wave(2.0, 0.1, 0.05, 1.0), Wave(1.0, -0.1, 0.2, 0.0))),
}


def soft(bank, seed=0):
    """A texture that linear interpolation between pixels follows to a grey level or two."""
    rng = np.random.default_rng(seed)
    texture = bank.texture(rng, plain=0)
    softest = list(PATTERNS).index("soft")
    return replace(texture, image=bank.tiles[softest], texels=1.0, modulation=None)


def near_outlines(disparity):
    """Pixels two or fewer from a step of the disparity, where two surfaces blend."""
    step = np.abs(np.diff(disparity, axis=1)) > 0.7
    step = np.pad(step, ((0, 0), (0, 1))) | np.pad(step, ((0, 0), (1, 0)))
    down = np.abs(np.diff(disparity, axis=0)) > 0.7
    step |= np.pad(down, ((0, 1), (0, 0))) | np.pad(down, ((1, 0), (0, 0)))
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            step = step | np.roll(step, shift, axis)
    return step


@pytest.mark.parametrize("kind", SMOOTH)
def test_both_views_see_one_surface(bank, kind):
    scene = Scene((64, 128), (Layer(SMOOTH[kind], soft(bank)),))
    left, right = render_view(scene, "left"), render_view(scene, "right")
    columns, rows = np.meshgrid(np.arange(128, dtype=np.float32), np.arange(64, dtype=np.float32))
    np.testing.assert_array_equal(left.disparity, SMOOTH[kind].disparity_at(columns, rows[:, :1]))
    match = columns - left.disparity
    np.testing.assert_array_equal(left.nonocc, (match >= 0) & (match <= 127))
    # the map of the right view, read between its pixels
    for row in range(64):
        seen = left.nonocc[row]
        between = np.interp(match[row, seen], np.arange(128), right.disparity[row])
        np.testing.assert_allclose(between, left.disparity[row, seen], atol=0.01)
    image = np.stack([np.interp(match[9], np.arange(128), right.image[9, :, c]) for c in range(3)], axis=1)
    seen = left.nonocc[9]
    assert np.abs(image - left.image[9])[seen].max() <= 3
    assert left.image[9].std() > 5


@pytest.mark.parametrize("index", range(12))
def test_warping_the_right_view_gives_the_left_one(scenes, index):
    pair = scenes[index]
    for sample in (pair, flip_and_swap(pair)):
        calm = ~near_outlines(sample.disparity)
        match = np.clip(np.rint(np.arange(192) - sample.disparity).astype(int), 0, 191)
        calm &= ~np.take_along_axis(near_outlines(sample.right_disparity), match, axis=1)
        pure = replace(sample, nonocc=sample.nonocc & calm)
        if pure.nonocc.sum() < 200:
            continue
        error = errors(pure).mean()
        # what interpolation does by itself: a view between two halves of its pixels
        right = sample.right.astype(float)
        allowed = np.abs(right[:, 1:-1] - (right[:, :-2] + right[:, 2:]) / 2).mean()
        assert error <= 0.5 * allowed + 1
        if sample.left.std() > 15:
            for wrong in (-0.5, 0.5):
                moved = replace(pure, disparity=pure.disparity + np.float32(wrong))
                assert errors(moved).mean() > error


@pytest.mark.parametrize("index", range(12))
def test_left_and_right_truth_agree(scenes, index):
    pair = scenes[index]
    for sample in (pair, flip_and_swap(pair)):
        match = np.arange(192) - sample.disparity
        low = np.clip(np.floor(match).astype(int), 0, 191)
        beside = [np.take_along_axis(sample.right_disparity, np.minimum(low + step, 191), axis=1) for step in (0, 1)]
        off = np.min([np.abs(other - sample.disparity) for other in beside], axis=0)
        assert (off[sample.nonocc] < 0.8).mean() > 0.99
        hidden = ~sample.nonocc & (match > 0) & (match < 191)
        # before a hidden pixel stands something nearer
        assert (np.max(beside, axis=0) > sample.disparity)[hidden].mean() > 0.97


@pytest.mark.parametrize("index", range(6))
def test_warping_holds_under_shadows_and_among_likes(index):
    options = {"seed": 3, "size": (96, 192), "max_disparity": 48, "photometric": 0}
    test_warping_the_right_view_gives_the_left_one(SyntheticScenes(**options, shaded=1, alike=0.5), index)


def test_shade_darkens_what_both_views_see(bank):
    surface = SMOOTH["plane"]
    bright = Layer(surface, soft(bank))
    half = np.full((256, 3), 128, np.uint8)
    dim = replace(bright, shade=replace(soft(bank, 1), palette=half))
    for view in ("left", "right"):
        full = render_view(Scene((64, 128), (bright,)), view).image.astype(float)
        shaded = render_view(Scene((64, 128), (dim,)), view).image
        np.testing.assert_allclose(shaded, full * 128 / 255, atol=0.51)


@pytest.mark.parametrize("strength", [0.0, 1.0])
def test_reflections_move_by_their_own_disparity(bank, strength):
    dull = Layer(Surface((64.0, 32.0), 12.0), soft(bank))
    glossy = replace(dull, reflection=Reflection(soft(bank, 1), 4.0, strength))
    left, right = (render_view(Scene((64, 128), (glossy,)), view) for view in ("left", "right"))
    moves = 4 if strength else 12
    np.testing.assert_array_equal(left.image[:, moves:], right.image[:, :-moves])
    for view, seen in (("left", left), ("right", right)):
        alone = render_view(Scene((64, 128), (dull,)), view)
        np.testing.assert_array_equal(seen.disparity, alone.disparity)
        np.testing.assert_array_equal(seen.nonocc, alone.nonocc)
        assert (seen.image == alone.image).all() == (strength == 0)


def splatted(scene, view, fine=8):
    """The largest disparity of any surface at each eighth of a column of the other view.

    It comes from the left view's coordinates alone, by throwing densely taken points of each surface over.
    """
    height, width = scene.size
    buffer = np.full((height, width * fine), -np.inf)
    columns = np.arange(-20, 2 * width, 1 / (4 * fine), dtype=np.float32)
    for row in range(height):
        v = np.full((1, 1), row, np.float32)
        for layer in scene.layers:
            disparity = layer.surface.disparity_at(columns[None], v)[0]
            inside = np.ones(len(columns), bool)
            if layer.shape is not None:
                u0, v0 = layer.surface.centre
                inside = layer.shape.distance(columns[None] - np.float32(u0), v - np.float32(v0))[0] < 0
            place = columns - disparity if view == "left" else columns
            bins = np.rint(place * fine).astype(int)
            inside &= (bins >= 0) & (bins < width * fine)
            np.maximum.at(buffer[row], bins[inside], disparity[inside])
    return buffer


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("view", ["left", "right"])
def test_masks_agree_with_a_z_buffer(bank, index, view):
    scene = Composition(size=(32, 96), max_disparity=30).scene(np.random.default_rng(index), bank)
    rendered = render_view(scene, view)
    fine = 8
    buffer = splatted(scene, view, fine)
    match = np.arange(96) + (rendered.disparity if view == "right" else -rendered.disparity)
    bins = np.rint(match * fine).astype(int)
    inside = (match >= 0) & (match <= 95)
    np.testing.assert_array_equal(rendered.nonocc & ~inside, False)
    rows = np.arange(32)[:, None]
    around = np.array([buffer[rows, np.clip(bins + step, 0, 96 * fine - 1)] for step in (-2, -1, 0, 1, 2)])
    nearer = around - rendered.disparity
    # six tenths of a pixel is more than a steep surface changes between the bins
    surely_hidden, surely_seen = inside & (nearer > 0.6).all(axis=0), inside & (nearer < 0.01).all(axis=0)
    assert not (rendered.nonocc & surely_hidden).any()
    assert not (~rendered.nonocc & surely_seen).any()
    assert rendered.nonocc[inside & (nearer < 0.6).all(axis=0)].mean() > 0.98
    assert (surely_hidden.sum() > 10) | (rendered.nonocc[inside].mean() > 0.98)
    assert (surely_hidden | surely_seen)[inside].mean() > 0.3


def test_the_nearest_surface_wins_and_blends_at_its_outline(bank):
    far = Layer(Surface((48.0, 16.0), 4.0), soft(bank, 1))
    board = Layer(Surface((50.25, 16.0), 10.0), soft(bank, 2), Box(10.0, 40.0))
    alone = {}
    for layer in (far, board):
        without_end = replace(layer, shape=None)
        alone[layer] = render_view(Scene((32, 96), (without_end,)), "left").image.astype(float)
    for layers in ((far, board), (board, far)):
        view = render_view(Scene((32, 96), layers), "left")
        np.testing.assert_array_equal(view.disparity[5, 38:64], [4] * 3 + [10] * 20 + [4] * 3)
        np.testing.assert_array_equal(view.image[:, 42:60], alone[board][:, 42:60])
        np.testing.assert_array_equal(view.image[:, 62:], alone[far][:, 62:])
    view = render_view(Scene((32, 96), (far, board)), "left")
    # the board ends at 40.25 and 60.25: it covers a quarter of pixel 40 and three quarters of 60
    for column, part in ((40, 0.25), (60, 0.75)):
        mixed = part * alone[board][:, column] + (1 - part) * alone[far][:, column]
        assert np.abs(view.image[:, column] - mixed).max() <= 1
    right = render_view(Scene((32, 96), (far, board)), "right")
    np.testing.assert_array_equal(np.flatnonzero(right.disparity[5] == 10), np.arange(31, 51))
    # the board hides six columns of the wall, and four are beyond the border
    np.testing.assert_array_equal(np.flatnonzero(~view.nonocc[5]), [0, 1, 2, 3, *range(35, 41)])
    np.testing.assert_array_equal(np.flatnonzero(~right.nonocc[5]), [*range(51, 57), *range(92, 96)])


def test_something_must_lie_behind_all(bank):
    board = Layer(Surface((48.0, 16.0), 10.0), soft(bank), Box(10.0, 40.0))
    with pytest.raises(InputError, match="a layer without an end"):
        Scene((32, 96), (board,))
