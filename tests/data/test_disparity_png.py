import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.disparity_png import (
    read_drivingstereo_full_png,
    read_kitti_png,
    read_scaled_png,
    read_sintel_png,
    write_kitti_png,
)
from stereokit.data.images import read_samples, write_samples
from stereokit.errors import InputError
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared

SHAPE = st.tuples(st.integers(1, 9), st.integers(1, 9))
LARGEST = 65535 / 256


@given(hnp.arrays(np.uint16, SHAPE))
def test_kitti_integers_survive(tmp_path_factory, samples):
    path = tmp_path_factory.getbasetemp() / "a.png"
    write_samples(path, samples, overwrite=True)
    values = read_kitti_png(path)
    np.testing.assert_array_equal(np.isnan(values), samples == 0)
    write_kitti_png(path, values, overwrite=True)
    np.testing.assert_array_equal(read_samples(path), samples)


@given(hnp.arrays(np.float32, SHAPE, elements=st.floats(0, LARGEST, width=32) | st.just(np.nan) | st.just(np.inf)))
def test_kitti_keeps_what_is_known_within_half_a_step(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "a.png"
    write_kitti_png(path, values, overwrite=True)
    back = read_kitti_png(path)
    known = np.isfinite(values)
    np.testing.assert_array_equal(np.isfinite(back), known)
    assert (np.abs(back - values)[known] <= np.where(values[known] < 1 / 512, 1 / 256, 1 / 512)).all()


@pytest.mark.parametrize("value", [-1e-3, -1, 255.999, 256, 1e30])
def test_kitti_does_not_wrap(tmp_path, value):
    with pytest.raises(InputError, match=r"from 0 to 255\.996, got 1\.0 to|from 0 to 255\.996, got -.* to 1\.0"):
        write_kitti_png(tmp_path / "a.png", [[1.0, value, np.nan]])
    assert not list(tmp_path.iterdir())


def test_kitti_needs_its_suffix_and_depth(tmp_path):
    with pytest.raises(InputError, match=r"ends in \.png"):
        write_kitti_png(tmp_path / "a.jpg", [[1.0]])
    write_samples(tmp_path / "a.png", np.ones((2, 2), np.uint8), overwrite=False)
    with pytest.raises(InputError, match="uint8 samples in 1 channels; expected a 16-bit grey PNG"):
        read_kitti_png(tmp_path / "a.png")
    write_samples(tmp_path / "b.png", np.ones((2, 2, 3), np.uint16), overwrite=False)
    with pytest.raises(InputError, match="uint16 samples in 3 channels"):
        read_kitti_png(tmp_path / "b.png")


def test_drivingstereo_full_size(tmp_path):
    write_samples(tmp_path / "a.png", np.array([[0, 128, 12800]], np.uint16), overwrite=False)
    assert read_drivingstereo_full_png(tmp_path / "a.png").tolist()[0][1:] == [1, 100]
    assert np.isnan(read_drivingstereo_full_png(tmp_path / "a.png")[0, 0])


@pytest.mark.parametrize("suffix", [".png", ".pgm"])
@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_scaled(tmp_path, suffix, channels, depth):
    if suffix == ".pgm" and channels:
        suffix = ".ppm"
    samples = np.array([[0, 10, 255]], depth)
    path = tmp_path / f"a{suffix}"
    write_samples(path, np.broadcast_to(samples[..., None], (1, 3, 3)) if channels else samples, overwrite=False)
    np.testing.assert_array_equal(read_scaled_png(path, scale=4), [[np.nan, 2.5, 63.75]])


def test_scaled_refuses_pictures_and_scales(tmp_path):
    write_samples(tmp_path / "a.png", np.arange(12, dtype=np.uint8).reshape(2, 2, 3), overwrite=False)
    with pytest.raises(InputError, match=r"colour image; expected grey, of disparity \* 4"):
        read_scaled_png(tmp_path / "a.png", scale=4)
    for scale in (0, -1, float("nan"), float("inf")):
        with pytest.raises(InputError, match="scale must be a positive number"):
            read_scaled_png(tmp_path / "a.png", scale=scale)


@given(hnp.arrays(np.float64, SHAPE, elements=st.floats(0, 1023)))
def test_sintel(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "a.png"
    red = np.floor(values / 4)
    green = np.floor(values * 2**6 % 256)
    blue = np.floor(values * 2**14 % 256)
    write_samples(path, np.stack([red, green, blue], axis=-1).astype(np.uint8), overwrite=True)
    np.testing.assert_allclose(read_sintel_png(path), values, atol=2**-13)


def test_sintel_is_colour(tmp_path):
    write_samples(tmp_path / "a.png", np.ones((2, 2), np.uint8), overwrite=False)
    with pytest.raises(InputError, match="no 8-bit colour image"):
        read_sintel_png(tmp_path / "a.png")


@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_no_file_crashes_the_readers(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.png"
    write_samples(path, np.arange(6, dtype=np.uint16).reshape(2, 3), overwrite=True)
    path.write_bytes(data.draw(damaged([path.read_bytes()])))
    for read in (read_kitti_png, read_sintel_png, lambda path: read_scaled_png(path, scale=2)):
        values = outcome(read, path)
        assert isinstance(values, str) or values.dtype == np.float32


@needs_shared
def test_real_kitti():
    occ, noc = (
        read_kitti_png(SHARED / "data" / "real" / "kitti2012" / "training" / kind / "000027_10.png")
        for kind in ("disp_occ", "disp_noc")
    )
    assert occ.shape == (376, 1241)
    assert 4 < np.nanmin(occ) < np.nanmax(occ) < 119
    assert 0.25 < np.isfinite(noc).mean() < np.isfinite(occ).mean() < 0.35
    assert np.isfinite(occ)[np.isfinite(noc)].all()
    assert (occ == noc)[np.isfinite(noc)].mean() > 0.99
