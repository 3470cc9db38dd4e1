import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.cameras import Calibration
from stereokit.cameras.cloud import PointCloud, flying, point_cloud
from stereokit.errors import ConfigError, InputError
from tests.strategies import seeds

CAMERA = Calibration(fx=90.0, baseline=0.1, cx0=5.5, cx1=7.25, width=12, height=8, fy=95.0, cy=3.25)


def scene(seed, height=8, width=12):
    """Disparity with unknown pixels, confidence and an image."""
    rng = np.random.default_rng(seed)
    disparity = rng.uniform(0.5, 40, (height, width)).astype(np.float32)
    disparity[rng.random((height, width)) < 0.2] = np.nan
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    return disparity, rng.random((height, width)).astype(np.float32), image


def to_opencv(cloud):
    x, y, z = cloud.points.astype(np.float64).T
    return {"opencv": (x, y, z), "opengl": (x, -y, -z), "ros": (-y, -z, x)}[cloud.axes]


@given(seeds, st.sampled_from(["opencv", "opengl", "ros"]))
def test_points_project_back_to_their_pixel_and_disparity(seed, axes):
    disparity, confidence, image = scene(seed)
    cloud = point_cloud(disparity, CAMERA, image, confidence=confidence, axes=axes)
    rows, columns = np.divmod(cloud.pixels, 12)
    x, y, z = to_opencv(cloud)
    left, right = CAMERA.cx0 + CAMERA.fx * x / z, CAMERA.cx1 + CAMERA.fx * (x - CAMERA.baseline) / z
    np.testing.assert_allclose(left, columns, atol=1e-4)
    np.testing.assert_allclose(CAMERA.cy + CAMERA.fy * y / z, rows, atol=1e-4)
    np.testing.assert_allclose(left - right, disparity[rows, columns], atol=1e-4)
    assert len(cloud) == np.isfinite(disparity).sum()
    np.testing.assert_array_equal(cloud.colors, image[rows, columns])
    np.testing.assert_array_equal(cloud.confidence, confidence[rows, columns])


@given(seeds, st.floats(0, 1), st.floats(0.1, 5))
def test_filters_leave_out_what_they_name(seed, least, most):
    disparity, confidence, image = scene(seed)
    valid = np.random.default_rng(seed).random(disparity.shape) < 0.7
    cloud = point_cloud(
        disparity, CAMERA, image, confidence=confidence, min_confidence=least, valid=valid, max_depth=most
    )
    expected = np.isfinite(disparity) & valid & (confidence >= least) & (CAMERA.depth(disparity) <= most)
    np.testing.assert_array_equal(cloud.pixels, np.flatnonzero(expected))


def test_holes_are_left_or_filled_with_the_background():
    nan = np.nan
    disparity, image = np.array([[30, 30, nan, nan, 5.0]]), np.zeros((1, 5, 3), np.uint8)
    camera = Calibration(fx=90.0, baseline=0.1, cx0=0.0, cx1=0.0, cy=0.0)
    assert point_cloud(disparity, camera, image).pixels.tolist() == [0, 1, 4]
    filled = point_cloud(disparity, camera, image, holes="background")
    np.testing.assert_allclose(filled.points[:, 2], 9 / np.array([30, 30, 5, 5, 5.0]), rtol=1e-6)


def test_flying_points_go_and_surfaces_stay():
    rows, columns = np.mgrid[:40, :60].astype(np.float64)
    slanted = 5 + 0.8 * columns + 0.3 * rows
    assert not flying(slanted).any()
    step = np.where(columns < 30, 40.0, 10.0)
    assert not flying(step).any()
    thin = np.where(columns == 30, 40.0, 10.0)  # a wire of one pixel
    assert not flying(thin).any()
    ramp = step.copy()
    ramp[:, 29:32] = [32, 25, 17]  # what upsampling makes of the step
    np.testing.assert_array_equal(flying(ramp), (columns >= 29) & (columns <= 31))
    np.testing.assert_array_equal(flying(ramp.T), flying(ramp).T)
    assert not flying(np.full((1, 1), 3.0)).any()
    camera = Calibration(fx=90.0, baseline=0.1, cx0=0.0, cx1=0.0, cy=0.0)
    cloud = point_cloud(ramp, camera, np.zeros((40, 60, 3), np.uint8), edge_filter=1.0)
    assert np.unique(cloud.points[:, 2].round(4)).tolist() == pytest.approx([9 / 40, 9 / 10])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"calibration": Calibration(90.0, 0.1, 5.5, 7.25)}, "does not say cy"),
        ({"calibration": Calibration(90.0, 0.1, 5.5, 7.25, 24, 16, cy=1.0)}, "24 x 16 pixels, these have 12 x 8"),
        ({"image": np.zeros((8, 12), np.uint8)}, r"expected RGB \(H, W, 3\)"),
        ({"image": np.zeros((8, 13, 3), np.uint8)}, "the image has shape"),
        ({"confidence": np.zeros((8, 13))}, "the confidence has shape"),
        ({"valid": np.zeros((9, 12), bool)}, "the valid mask has shape"),
        ({"min_confidence": 0.5}, "needs the confidence"),
        ({"min_confidence": 1.5, "confidence": np.zeros((8, 12))}, "from 0 to 1, got 1.5"),
        ({"holes": "fill"}, "'leave' or 'background', got 'fill'"),
        ({"axes": "unity"}, "got 'unity'"),
        ({"edge_filter": -1}, "at least 0 px"),
        ({"max_depth": -1}, "max_depth"),
    ],
)
def test_bad_input(change, message):
    disparity, _, image = scene(0)
    with pytest.raises(InputError, match=message):
        point_cloud(**{"disparity": disparity, "calibration": CAMERA, "image": image, **change})


def read_ply(path):
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[2])
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    values = np.frombuffer(body, fields)
    assert len(values) == count
    confidence = values["confidence"] if "confidence" in values.dtype.names else None
    colors = np.stack([values[name] for name in ("red", "green", "blue")], axis=1)
    return np.stack([values[name] for name in "xyz"], axis=1), colors, confidence


def read_pcd(path):
    header, _, body = path.read_bytes().partition(b"DATA binary\n")
    entries = dict(line.split(" ", 1) for line in header.decode().splitlines())
    fields = entries["FIELDS"].split()
    values = np.frombuffer(body, [(name, "<f4") for name in fields])
    assert len(values) == int(entries["POINTS"]) == int(entries["WIDTH"])
    packed = values["rgb"].copy().view("<u4")
    colors = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1)
    points = np.stack([values[name] for name in "xyz"], axis=1)
    return points, colors, values["confidence"] if "confidence" in fields else None


@pytest.mark.parametrize(("suffix", "read"), [(".ply", read_ply), (".pcd", read_pcd)])
@given(seed=seeds, with_confidence=st.booleans(), count=st.integers(0, 20))
def test_files_come_back(tmp_path_factory, suffix, read, seed, with_confidence, count):
    rng = np.random.default_rng(seed)
    confidence = rng.random(count).astype(np.float32) if with_confidence else None
    points = rng.normal(0, 10, (count, 3)).astype(np.float32)
    cloud = PointCloud(points, rng.integers(0, 256, (count, 3), np.uint8), np.arange(count), confidence)
    path = tmp_path_factory.getbasetemp() / f"cloud{suffix}"
    cloud.write(path, overwrite=True)
    found = read(path)
    np.testing.assert_array_equal(found[0], points)
    np.testing.assert_array_equal(found[1], cloud.colors)
    assert (found[2] is None) == (confidence is None)
    if confidence is not None:
        np.testing.assert_array_equal(found[2], confidence)


@pytest.mark.parametrize("count", [0, 1, 50])
@pytest.mark.parametrize("spread", [10, 1e6])
def test_las(tmp_path, count, spread):
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(0)
    points = rng.normal(0, spread, (count, 3)).astype(np.float32)
    cloud = PointCloud(
        points, rng.integers(0, 256, (count, 3), np.uint8), np.arange(count), rng.random(count).astype("f4"), "ros"
    )
    cloud.write(tmp_path / "a.las")
    file = laspy.read(tmp_path / "a.las")
    np.testing.assert_allclose(file.xyz, points, atol=max(1e-4, spread * 1e-8))
    np.testing.assert_array_equal(np.stack([file.red, file.green, file.blue], axis=1) // 257, cloud.colors)
    np.testing.assert_array_equal(file.confidence, cloud.confidence)
    assert file.header.system_identifier == "axes ros, metres"


def test_las_without_laspy_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match=r"pip install 'stereokit\[las\]'"):
        point_cloud(*scene(0)[:1], CAMERA, scene(0)[2]).write(tmp_path / "a.las")
    with pytest.raises(InputError, match=r"written as \.ply, \.pcd, \.las, not '\.obj'"):
        point_cloud(*scene(0)[:1], CAMERA, scene(0)[2]).write(tmp_path / "a.obj")
    assert not list(tmp_path.iterdir())
