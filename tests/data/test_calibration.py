import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data import Calibration, read_calibration
from stereokit.data.calibration import (
    read_kitti_calibration,
    read_middlebury_calibration,
    read_opencv_calibration,
)
from stereokit.errors import InputError
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared


def close(left, right):
    return (left.width, left.height) == (right.width, right.height) and all(
        getattr(left, key) == pytest.approx(getattr(right, key), rel=1e-6, abs=1e-6)
        for key in ("fx", "baseline", "cx0", "cx1")
    )


def row(values):
    return " ".join(f"{value:.12e}" for value in values)


def projection(camera, cx, x):
    """The matrix of a rectified camera that stands `x` metres to the right."""
    return [camera.fx, 0, cx, -camera.fx * x, 0, camera.fx, 200, 0, 0, 0, 1, 0]


def kitti_2012(camera):
    left = projection(camera, camera.cx0, -0.06)
    right = projection(camera, camera.cx1, camera.baseline - 0.06)
    grey = projection(camera, 0, 0)
    return f"P0: {row(grey)}\nP1: {row(grey)}\nP2: {row(left)}\nP3: {row(right)}\n"


def kitti_2015(camera):
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
    for number, cx, x in (("02", camera.cx0, 0), ("03", camera.cx1, camera.baseline)):
        text += f"S_rect_{number}: {row([camera.width, camera.height])}\n"
        text += f"P_rect_{number}: {row(projection(camera, cx, x))}\n"
    return text


def middlebury(camera):
    cam0, cam1 = (f"[{camera.fx!r} 0 {cx!r}; 0 {camera.fx!r} 200; 0 0 1]" for cx in (camera.cx0, camera.cx1))
    doffs, baseline = camera.cx1 - camera.cx0, camera.baseline * 1000
    return (
        f"cam0={cam0}\ncam1={cam1}\ndoffs={doffs!r}\nbaseline={baseline!r}\n"
        f"width={camera.width}\nheight={camera.height}\nndisp=290\nisint=0\nvmin=23\n"
    )


def opencv(tmp_path, camera, keys):
    left, right = projection(camera, camera.cx0, 0), projection(camera, camera.cx1, camera.baseline)
    q = np.zeros((4, 4))
    q[0, 0] = q[1, 1] = 1
    q[0, 3], q[1, 3], q[2, 3] = -camera.cx0, -200, camera.fx
    q[3, 2], q[3, 3] = 1 / camera.baseline, (camera.cx1 - camera.cx0) / camera.baseline
    matrices = {"P1": np.reshape(left, (3, 4)), "P2": np.reshape(right, (3, 4)), "Q": q, "R1": np.eye(3)}
    storage = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    for key in keys:
        storage.write(key, matrices[key])
    storage.release()
    return (tmp_path / "extrinsics.yml").read_text()


def yaml_matrix(key, rows, columns):
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ 1. ]\n"


CAMERAS = st.builds(
    Calibration,
    fx=st.floats(50, 5000),
    baseline=st.floats(0.01, 2),
    cx0=st.floats(1, 3000),
    cx1=st.floats(1, 3000),
    width=st.integers(1, 5000),
    height=st.integers(1, 5000),
)
CAMERA = Calibration(fx=700.5, baseline=0.5, cx0=320.25, cx1=330.5, width=640, height=480)


@given(camera=CAMERAS)
@settings(deadline=None)
def test_every_kind_says_the_same(tmp_path_factory, camera):
    folder = tmp_path_factory.getbasetemp()
    texts = [
        kitti_2015(camera),
        middlebury(camera),
        opencv(folder, camera, ["R1", "P1", "P2", "Q"]),
        opencv(folder, camera, ["Q"]),
    ]
    for text in texts:
        (folder / "calib").write_text(text)
        assert close(read_calibration(folder / "calib"), camera), text


def test_kitti_2012_names_no_size_and_has_two_pairs(tmp_path):
    (tmp_path / "a.txt").write_text(kitti_2012(CAMERA))
    colour = read_calibration(tmp_path / "a.txt")
    assert close(colour, Calibration(700.5, 0.5, 320.25, 330.5))
    with pytest.raises(InputError, match="baseline must be a positive"):  # the grey cameras stand together
        read_kitti_calibration(tmp_path / "a.txt", cameras=("0", "1"))
    with pytest.raises(InputError, match="has the cameras 0, 1, 2, 3; expected 4 and 5"):
        read_kitti_calibration(tmp_path / "a.txt", cameras=("4", "5"))


def test_drivingstereo_takes_the_baseline_from_the_translation(tmp_path):
    doubled = projection(CAMERA, CAMERA.cx1, 2 * CAMERA.baseline)
    text = f"S_rect_101: 640 480\nP_rect_101: {row(projection(CAMERA, CAMERA.cx0, 0))}\n"
    text += f"P_rect_103: {row(doubled)}\nT_103: -0.3 0 0.4\n"
    (tmp_path / "a.txt").write_text(text)
    assert close(read_calibration(tmp_path / "a.txt"), CAMERA)
    (tmp_path / "b.txt").write_text(text.replace("T_103", "T"))
    with pytest.raises(InputError, match="has no line 'T_103'"):
        read_calibration(tmp_path / "b.txt")


def test_middlebury_without_doffs_uses_the_second_camera(tmp_path):
    lines = middlebury(CAMERA).splitlines()
    (tmp_path / "a.txt").write_text("\r\n".join(line for line in lines if not line.startswith("doffs")))
    assert close(read_middlebury_calibration(tmp_path / "a.txt"), CAMERA)


def test_units(tmp_path):
    (tmp_path / "a.yml").write_text(opencv(tmp_path, CAMERA, ["P1", "P2"]))
    assert read_calibration(tmp_path / "a.yml", metres_per_unit=0.001).baseline == pytest.approx(0.0005)
    assert read_opencv_calibration(tmp_path / "a.yml").baseline == pytest.approx(0.5)
    (tmp_path / "a.txt").write_text(middlebury(CAMERA))
    assert read_calibration(tmp_path / "a.txt", metres_per_unit=1).baseline == pytest.approx(500)


@given(CAMERAS, st.floats(0.1, 100))
def test_depth_is_where_the_ray_meets(camera, metres):
    # A point on the left camera's axis at some depth is seen fx * baseline / depth further left in the
    # right view.
    seen_left = camera.cx0
    seen_right = camera.cx1 - camera.fx * camera.baseline / metres
    assert camera.depth(seen_left - seen_right) == pytest.approx(metres, rel=1e-4)


def test_depth_of_the_unknown():
    camera = Calibration(100, 1, 50, 50)
    np.testing.assert_array_equal(camera.depth([[np.nan, np.inf, 0, -1, 50]]), [[np.nan] * 4 + [2]])
    assert camera.depth([[1.0]]).dtype == np.float32
    # With an offset, a disparity of 0 is a depth like any other.
    np.testing.assert_array_equal(Calibration(100, 1, 50, 60).depth([0, -10, -20]), [10, np.nan, np.nan])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0}, "focal length"),
        ({"fx": float("nan")}, "focal length"),
        ({"baseline": -1}, "views are swapped"),
        ({"baseline": float("inf")}, "baseline"),
        ({"cx1": float("nan")}, "principal points"),
        ({"height": 0}, "image size"),
    ],
)
def test_impossible_cameras(change, message):
    arguments = {"fx": 1, "baseline": 1, "cx0": 0, "cx1": 0, "width": 1, "height": 1}
    with pytest.raises(InputError, match=message):
        Calibration(**{**arguments, **change})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no calibration that can be read; expected KITTI's"),
        ("hello: world", "no calibration that can be read"),
        ("P0: 1 2 3\nP1: 1 2 3", r"expected 12 numbers for P0, got '1 2 3'"),
        ("P0: " + "x " * 12 + "\nP1: " + "1 " * 12, "expected 12 numbers for P0"),
        ("P0: " + "nan " * 12 + "\nP1: " + "1 " * 12, "expected 12 numbers for P0"),
        ("P0: " + "0 " * 12 + "\nP1: " + "0 " * 12, "focal length must be"),
        ("P7: " + "1 " * 12, "has the cameras 7; expected a pair"),
        ("cam0=[1 0 2; 0 1 2; 0 0 1]\nbaseline=1", "has no line 'cam1'; it has cam0, baseline"),
        ("cam0=[1 0 2; 0 1 2; 0 0 1]\ndoffs=0", "has no line 'baseline'"),
        ("cam0=[1 0 2]\ndoffs=0", "expected 9 numbers for cam0"),
        ("cam0=[1 0 2; 0 1 2; 0 0 1]\ndoffs=0\nbaseline=-5", "views are swapped"),
        (yaml_matrix("M1", 1, 1), "holds the matrices M1; expected P1 and P2, or Q"),
        (yaml_matrix("P1", 1, 1) + yaml_matrix("P2", 1, 1), "expected a 3 x 4 matrix P1, got 1 x 1"),
        (yaml_matrix("Q", 100000, 100000), "expected a 4 x 4 matrix Q, got 100000 x 100000"),
        (yaml_matrix("Q", 4, 4), "expected 16 numbers for Q, got ' 1. '"),
        ("P0: " + "1" * 2**20, "more than 1048576 bytes"),
    ],
)
def test_malformed(tmp_path, text, message):
    (tmp_path / "calib.txt").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_calibration(tmp_path / "calib.txt")
    assert "calib.txt" in str(caught.value)


def test_missing(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_calibration(tmp_path / "absent.txt")


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_no_file_crashes_the_reader(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    texts = [kitti_2012(CAMERA), kitti_2015(CAMERA), middlebury(CAMERA), opencv(folder, CAMERA, ["P1", "P2"])]
    (folder / "damaged").write_bytes(data.draw(damaged([text.encode() for text in texts])))
    assert isinstance(outcome(read_calibration, folder / "damaged"), (str, Calibration))


@needs_shared
def test_real_files():
    real = SHARED / "data" / "real"
    eth3d = read_calibration(real / "eth3d" / "terrace" / "calib.txt")
    assert close(eth3d, Calibration(711.499, 0.0599432, 376.135, 376.135, 713, 434))
    kitti = read_calibration(real / "kitti2012" / "training" / "calib" / "000027.txt")
    assert kitti.baseline == pytest.approx(0.537, abs=0.001)
    assert kitti.depth(kitti.fx * kitti.baseline) == pytest.approx(1)
