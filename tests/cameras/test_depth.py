import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stereokit.cameras import Calibration
from stereokit.cameras.depth import depth_from_disparity, depth_standard_error, fill_background, write_depth
from stereokit.data import read_pfm
from stereokit.data.npy import read_npy
from stereokit.errors import InputError

CAMERA = Calibration(fx=700.0, baseline=0.12, cx0=320.0, cx1=323.0)
UNKNOWN = st.just(np.nan)
SHAPES = st.tuples(st.integers(1, 6), st.integers(1, 9))
DISPARITIES = SHAPES.flatmap(
    lambda shape: arrays(
        np.float32, shape, elements=UNKNOWN | st.sampled_from([0.0, -3.0, np.inf]) | st.floats(-5, 200, width=32)
    )
)
DEPTHS = SHAPES.flatmap(lambda shape: arrays(np.float32, shape, elements=UNKNOWN | st.floats(0.125, 120, width=32)))


@given(DISPARITIES, st.floats(0.5, 100))
@pytest.mark.filterwarnings("error")
def test_depth_is_the_naive_one_where_it_is_known(disparity, most):
    depth = depth_from_disparity(disparity, CAMERA, max_depth=most)
    for d, z in zip(disparity.ravel().tolist(), depth.ravel().tolist(), strict=True):
        there = np.isfinite(d) and d + 3.0 > 0 and np.float32(84.0 / (d + 3.0)) <= most
        assert z == pytest.approx(84.0 / (d + 3.0) if there else np.nan, rel=1e-6, nan_ok=True)


def test_the_mask_is_applied_and_sizes_are_checked():
    valid = np.array([[True, False]])
    np.testing.assert_array_equal(depth_from_disparity([[25, 25]], CAMERA, valid=valid), [[3, np.nan]])
    with pytest.raises(InputError, match="valid is float64"):
        depth_from_disparity([[25, 25]], CAMERA, valid=np.ones((1, 2)))
    with pytest.raises(InputError, match=r"valid is bool of shape \(1, 2\)"):
        depth_from_disparity([[25]], CAMERA, valid=valid)
    with pytest.raises(InputError, match="images of 4 x 3 pixels, these have 2 x 1"):
        depth_from_disparity([[25, 25]], CAMERA.sized(3, 4))
    with pytest.raises(InputError, match="max_depth must be a positive"):
        depth_from_disparity([[25]], CAMERA, max_depth=0)
    with pytest.raises(InputError, match="real numbers"):
        depth_from_disparity([25.0], CAMERA)


@given(st.floats(1, 200), st.floats(0.001, 0.1))
def test_standard_error_is_the_derivative(disparity, error):
    near, far = (float(CAMERA.depth(disparity + side * error)) for side in (1, -1))
    found = depth_standard_error([[disparity]], CAMERA, error).item()
    assert found == pytest.approx((far - near) / 2, rel=0.02, abs=1e-5)


def test_standard_error_of_the_unknown():
    error = depth_standard_error([[np.nan, 25, 25]], CAMERA, np.array([[1, np.nan, 1.0]]))
    np.testing.assert_allclose(error, [[np.nan, np.nan, 9 / 84]], rtol=1e-6)
    with pytest.raises(InputError, match="at least 0, got -1"):
        depth_standard_error([[25]], CAMERA, -1)
    with pytest.raises(InputError, match=r"has shape \(2,\)"):
        depth_standard_error([[25]], CAMERA, np.ones(2))


@given(DISPARITIES)
def test_background_is_the_smaller_neighbour(disparity):
    filled = fill_background(disparity)
    for row, result in zip(disparity, filled, strict=True):
        for x, value in enumerate(row):
            before = [other for other in row[:x] if np.isfinite(other)][-1:]
            after = [other for other in row[x + 1 :] if np.isfinite(other)][:1]
            expected = value if np.isfinite(value) else min(before + after, default=np.nan)
            np.testing.assert_array_equal(result[x], expected)


READERS = {
    ".npy": read_npy,
    ".npz": lambda path: np.load(path)["depth"],
    ".pfm": read_pfm,
    ".tif": lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED),
    ".tiff": lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED),
}


@pytest.mark.parametrize("suffix", READERS)
@given(DEPTHS)
def test_metres_come_back_as_they_were(tmp_path_factory, suffix, depth):
    path = tmp_path_factory.getbasetemp() / f"depth{suffix}"
    assert write_depth(path, depth, overwrite=True) == 0
    np.testing.assert_array_equal(READERS[suffix](path), depth)


@given(DEPTHS)
def test_millimetres_are_rounded_and_what_is_too_far_is_counted(tmp_path_factory, depth):
    path = tmp_path_factory.getbasetemp() / "depth.png"
    beyond = write_depth(path, depth, overwrite=True)
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    held = depth < 65.5355
    assert beyond == np.count_nonzero(np.isfinite(depth) & ~held)
    assert (stored[~held] == 0).all()
    np.testing.assert_allclose(stored[held] / 1000, depth[held], atol=0.000501)
    assert write_depth(path, [[1e-5]], overwrite=True) == 0  # known, however near
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tolist() == [[1]]


def test_what_is_no_depth_is_not_written(tmp_path):
    for depth, name, message in [
        ([[0.0]], "a.npy", "depth is positive, and NaN where unknown; got 0"),
        ([[-1.0]], "a.png", "got -1"),
        ([1.0], "a.npy", "real numbers of shape"),
        ([[1.0]], "a.jpg", "depth is written as .png"),
    ]:
        with pytest.raises(InputError, match=message):
            write_depth(tmp_path / name, depth)
    write_depth(tmp_path / "a.npy", [[1.0]])
    with pytest.raises(InputError, match="exists already"):
        write_depth(tmp_path / "a.npy", [[1.0]])
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


def test_the_farthest_that_millimetres_hold(tmp_path):
    assert write_depth(tmp_path / "a.png", [[65.535, 65.536]]) == 1
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).tolist() == [[65535, 0]]
