import pickle

import numpy as np
import pytest

from stereokit.data.images import write_image
from stereokit.data.synthetic.textures import Ground, Texture, TextureBank, _photograph, random_palette
from stereokit.errors import ConfigError, InputError

V = np.arange(40, 90, dtype=np.float32)[:, None]
U = np.broadcast_to(np.arange(100, dtype=np.float32), (50, 100))


@pytest.mark.parametrize("seed", range(8))
def test_colours_belong_to_places_on_the_surface(bank, seed):
    texture = bank.texture(np.random.default_rng(seed), plain=0)
    disparity = 0.3 * U
    whole = texture.colours(U, V, disparity)
    assert whole.shape == (50, 100, 3)
    assert whole.std() > 0.5
    # another window, other neighbours, and the same colours
    part = texture.colours(U[5:20, 30:60][:, ::-1], V[5:20], disparity[5:20, 30:60][:, ::-1])
    np.testing.assert_allclose(part[:, ::-1].astype(int), whole[5:20, 30:60], atol=1)


def test_a_texture_is_smooth_between_pixels(bank):
    """Half a pixel further is half the way, but for what bends between two pixels."""
    texture = bank.texture(np.random.default_rng(1), plain=0)
    at, half, one = (texture.colours(U + step, V, U).astype(float) for step in (0.0, 0.5, 1.0))
    between = np.abs(half - (at + one) / 2).mean()
    assert between < 0.35 * np.abs(one - at).mean() + 0.5


def test_a_ground_gets_finer_with_distance(bank):
    rows = np.arange(100, 256, dtype=np.float32)[:, None]
    columns = np.broadcast_to(np.arange(200, dtype=np.float32), (156, 200))
    ground = Ground(near=80.0, column=100.0, horizon=96.0, reach=160.0)
    disparity = np.broadcast_to((rows - 96) / 2, (156, 200)).astype(np.float32)
    rng = np.random.default_rng(0)
    turns = []
    for _ in range(12):
        texture = bank.texture(rng, plain=0, ground=ground)
        colours = texture.colours(columns, rows, disparity).astype(float).mean(axis=2)
        same = texture.colours(columns[20:50] + 0, rows[20:50], disparity[20:50])
        np.testing.assert_array_equal(same.mean(axis=2), colours[20:50])
        crossings = (np.diff(np.sign(colours - colours.mean(axis=1, keepdims=True)), axis=1) != 0).mean(axis=1)
        turns.append((crossings[15:40].mean(), crossings[-30:].mean()))
    far, near = np.mean(turns, axis=0)
    assert far > 1.5 * near


def test_palettes():
    for seed in range(20):
        palette = random_palette(np.random.default_rng(seed), 1.0)
        assert palette.shape == (256, 3)
        plain = random_palette(np.random.default_rng(seed), 0.0)
        assert (plain == plain[0]).all()
        assert np.abs(random_palette(np.random.default_rng(seed), 0.1).astype(int) - plain).max() <= 26


def test_how_often_surfaces_are_blank():
    def blank(factor):
        bank = TextureBank(0, tiles=1, plain=factor)
        rng = np.random.default_rng(0)
        spreads = np.array([np.ptp(bank.texture(rng, plain=0.5).palette, axis=0).max() for _ in range(200)])
        # contrasts end at 0.15 where there is next to none, and begin at 0.3 elsewhere, of colours that may be alike
        return (spreads < 0.15 * 255).mean()

    assert blank(0.0) + 0.2 < blank(1.0) < blank(2.0) - 0.2
    assert blank(2.0) == 1
    with pytest.raises(ConfigError, match="plain must be at least 0, got -1"):
        TextureBank(0, tiles=1, plain=-1)


def test_photographs(tmp_path):
    with pytest.raises(InputError, match="no images to use as textures"):
        TextureBank(0, tiles=1, photographs=tmp_path)
    red = np.zeros((60, 90, 3), np.uint8)
    red[:, 30:60, 0] = 255
    write_image(tmp_path / "red.png", red)
    write_image(tmp_path / "deep.png", red / 255)
    bank = TextureBank(0, tiles=1, photographs=tmp_path)
    assert len(bank.photographs) == 2
    np.testing.assert_array_equal(*(_photograph(path)[0] for path in bank.photographs))
    # a loader's process is sent names, not images
    assert len(pickle.dumps(bank.photographs)) < 1000
    rng = np.random.default_rng(0)
    textures = [bank.texture(rng, plain=0) for _ in range(40)]
    used = [texture for texture in textures if texture.image[0].ndim == 3]
    assert 8 < len(used) < 32
    for texture in used[:5]:
        spread = texture.colours(3 * U, V, U).reshape(-1, 3).std(axis=0)
        assert spread[0] > 3 * max(spread[1:])
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"broken\.png"):
        TextureBank(0, tiles=1, photographs=tmp_path)


def test_skies_have_little_contrast(bank):
    rng = np.random.default_rng(0)
    spreads = [bank.sky(rng).colours(U, V, U).std(axis=(0, 1)).max() for _ in range(20)]
    assert max(spreads) < 40
    assert min(spreads) == 0


GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def test_tiles_repeat_and_photographs_are_mirrored():
    rng = np.random.default_rng(0)
    tile, photograph = rng.integers(0, 256, (16, 24), np.uint8), rng.integers(0, 256, (16, 24, 3), np.uint8)
    rows = np.arange(-32, 48, dtype=np.float32)[:, None]
    columns = np.broadcast_to(np.arange(-48, 72, dtype=np.float32), (80, 120))
    texture = Texture((tile,), GREYS, 0.0, 1.0, (0.0, 0.0))
    np.testing.assert_array_equal(texture.colours(columns, rows, columns)[..., 0], np.tile(tile, (5, 5)))
    texture = Texture((photograph,), GREYS, 0.0, 1.0, (0.0, 0.0))
    padded = np.pad(photograph, ((32, 32), (48, 48), (0, 0)), mode="symmetric")
    np.testing.assert_array_equal(texture.colours(columns, rows, columns), padded)


def test_coarse_levels_lie_on_the_fine_one():
    ramp = np.broadcast_to(np.arange(32, dtype=np.uint8) * 7, (32, 32))
    levels = tuple(ramp.reshape(32 >> k, 1 << k, 32 >> k, 1 << k).mean(axis=(1, 3)).astype(np.uint8) for k in (0, 1, 2))
    rows, columns = np.arange(4, 12, dtype=np.float32)[:, None], np.arange(10, 20, dtype=np.float32) / 4
    for texels in (1.0, 2.0, 4.0):
        texture = Texture(levels, GREYS, 0.0, texels, (0.0, 0.0))
        places = np.broadcast_to(columns * 4 / texels, (8, 10)).astype(np.float32)
        seen = texture.colours(places, rows / np.float32(texels), places)[..., 0]
        assert np.abs(seen - 7.0 * columns * 4).max() <= 3


def test_a_turned_texture():
    tile = np.random.default_rng(0).integers(0, 256, (16, 16), np.uint8)
    texture = Texture((tile,), GREYS, np.pi / 2, 1.0, (3.0, 5.0))
    rows = np.arange(16, dtype=np.float32)[:, None]
    seen = texture.colours(np.broadcast_to(np.arange(16, dtype=np.float32), (16, 16)), rows, rows)[..., 0]
    expected = tile[(5 - np.arange(16)[None]) % 16, (3 + np.arange(16)[:, None]) % 16]
    assert np.abs(seen.astype(int) - expected).max() <= 1
