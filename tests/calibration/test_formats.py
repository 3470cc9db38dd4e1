import json
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.calibration.formats.foundation_stereo import read_foundation_stereo_calibration
from stereokit.calibration.formats.kitti import read_kitti_calibration
from stereokit.calibration.formats.middlebury import read_middlebury_calibration
from stereokit.calibration.formats.opencv import read_opencv_calibration
from stereokit.calibration.formats.ros import read_ros_calibration
from stereokit.calibration.formats.yaml_subset import parse_yaml
from stereokit.cameras import Calibration, read_calibration, write_calibration
from stereokit.errors import InputError
from tests.calibration.drawn import cameras
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared


def close(left, right):
    return (left.width, left.height) == (right.width, right.height) and all(
        getattr(left, key) == pytest.approx(getattr(right, key), rel=1e-6, abs=1e-6)
        for key in ("fx", "fy", "baseline", "cx0", "cx1", "cy")
    )


def same(left, right):
    """All numbers equal to 1e-9 of their size."""
    left, right = left.to_dict(), right.to_dict()
    return left.keys() == right.keys() and all(
        value == pytest.approx(right[key], rel=1e-9, abs=1e-9) if isinstance(value, float) else value == right[key]
        for key, value in left.items()
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


CAMERAS = cameras(width=st.integers(1, 5000), height=st.integers(1, 5000), cy=st.just(200.0))
CAMERA = Calibration(fx=700.5, baseline=0.5, cx0=320.25, cx1=330.5, width=640, height=480, cy=200.0)


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
    assert close(colour, Calibration(700.5, 0.5, 320.25, 330.5, cy=200.0))
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


FULL_CAMERAS = cameras(
    cx0=st.floats(-100, 3000),
    cx1=st.floats(-100, 3000),
    fy=st.floats(50, 5000),
    cy=st.floats(-100, 3000),
)
SIZES = st.none() | st.tuples(st.integers(1, 5000), st.integers(1, 5000))


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("stereokit", "a.json"),
        ("opencv", "a.yml"),
        ("opencv", "a.yaml"),
        ("opencv", "a.xml"),
        ("opencv", "a.json"),
        ("kitti", "a.txt"),
        ("middlebury", "a.txt"),
        ("foundation_stereo", "K.txt"),
        ("ros", "left.yaml"),
    ],
)
@given(camera=FULL_CAMERAS, size=SIZES)
def test_round_trip(tmp_path_factory, kind, name, camera, size):
    path = tmp_path_factory.getbasetemp() / name
    if kind == "foundation_stereo":  # which knows neither
        camera, size = replace(camera, cx1=camera.cx0), None
    if kind == "ros":
        size = size or (640, 480)
    if size is not None:
        camera = camera.sized(*size)
    write_calibration(path, camera, kind=kind, overwrite=True)
    assert same(read_calibration(path), camera)
    # the byte order mark and the line ends of another system
    text = path.read_text().replace("\n", "\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert same(read_calibration(path), camera)
    path.write_bytes(text.encode("utf-16"))
    assert same(read_calibration(path), camera)


def test_opencv_reads_what_was_written_as_we_do(tmp_path):
    write_calibration(tmp_path / "a.yml", CAMERA)
    storage = cv2.FileStorage(str(tmp_path / "a.yml"), cv2.FILE_STORAGE_READ)
    points = cv2.reprojectImageTo3D(np.full((480, 640), 20, np.float32), storage.getNode("Q").mat())
    assert points[7, 9, 2] == pytest.approx(CAMERA.depth(20.0), rel=1e-6)
    assert points[7, 9, 0] == pytest.approx((9 - CAMERA.cx0) * CAMERA.depth(20.0) / CAMERA.fx, rel=1e-6)
    assert storage.getNode("image_width").real() == 640


def test_what_a_format_can_not_say_is_refused(tmp_path):
    no_cy, no_size = replace(CAMERA, cy=None), replace(CAMERA, width=None, height=None)
    for kind, name in [("opencv", "a.yml"), ("kitti", "a.txt"), ("middlebury", "a.txt"), ("ros", "left.yaml")]:
        with pytest.raises(InputError, match="does not say cy"):
            write_calibration(tmp_path / name, no_cy, kind=kind)
    with pytest.raises(InputError, match=r"cx0 = 320\.25 and cx1 = 330\.5"):
        write_calibration(tmp_path / "K.txt", CAMERA, kind="foundation_stereo")
    with pytest.raises(InputError, match="needs the size of the images"):
        write_calibration(tmp_path / "left.yaml", no_size, kind="ros")
    with pytest.raises(InputError, match=r"say the kind of calibration.*suffix '\.txt'"):
        write_calibration(tmp_path / "a.txt", CAMERA)
    with pytest.raises(InputError, match="got 'bouguet'"):
        write_calibration(tmp_path / "a.txt", CAMERA, kind="bouguet")
    with pytest.raises(InputError, match=r"is written as \.yml"):
        write_calibration(tmp_path / "a.txt", CAMERA, kind="opencv")
    with pytest.raises(InputError, match=r"the library's own \.json"):
        CAMERA.write(tmp_path / "a.yml")
    assert not list(tmp_path.iterdir())
    write_calibration(tmp_path / "a.json", no_cy)
    assert read_calibration(tmp_path / "a.json") == no_cy


def test_own_files_are_versioned(tmp_path):
    path = tmp_path / "a.json"
    for change, message in [
        ({"version": 2}, "has version 2; this release reads up to 1"),
        ({"version": True}, "has version True"),
        ({"fx": "1"}, "expected a number for fx, got 1"),
        ({"fx": 10**400}, "expected a number for fx"),
        ({"baseline": None}, "expected a number for baseline"),
        ({"image_size": [640]}, "expected image_size"),
        ({"fx": -1.0}, "focal length"),
    ]:
        path.write_text(json.dumps({**CAMERA.to_dict(), **change}))
        with pytest.raises(InputError, match=message) as caught:
            read_calibration(path)
        assert "a.json" in str(caught.value)
    path.write_text(json.dumps({**CAMERA.to_dict(), "about": "the lab"}))
    assert read_calibration(path) == CAMERA
    with pytest.raises(InputError, match=r"is in metres; leave out metres_per_unit=0\.001"):
        read_calibration(path, metres_per_unit=0.001)


ROS = """%YAML:1.0
---
image_width: 640   # pixels
image_height: 480
camera_name: 'narrow_stereo'
camera_matrix:
  rows: 3
  cols: 3
  data: [700.0, 0.0, 320.0,
         0.0, 700.0, 240.0,
         0.0, 0.0, 1.0]
projection_matrix: TAG
  rows: 3
  cols: 4
  dt: d
  data: [700., 0., 320.5, SHIFT, 0., 701., 240., 0., 0., 0., 1., 0.]
"""


@pytest.mark.parametrize("tag", ["", "!!opencv-matrix"])
@pytest.mark.parametrize("given_side", ["left", "right"])
def test_ros_pair(tmp_path, tag, given_side):
    for side, shift in (("left", "0.0"), ("right", "-84.0")):
        (tmp_path / f"my_{side}.yaml").write_text(ROS.replace("TAG", tag).replace("SHIFT", shift))
    expected = Calibration(700.0, 0.12, 320.5, 320.5, 640, 480, fy=701.0, cy=240.0)
    assert same(read_calibration(tmp_path / f"my_{given_side}.yaml"), expected)
    with pytest.raises(InputError, match="views are swapped"):
        read_ros_calibration(tmp_path / "my_right.yaml", tmp_path / "my_left.yaml")
    (tmp_path / "my_right.yaml").rename(tmp_path / "other.yaml")
    with pytest.raises(InputError, match=r"use read_ros_calibration\(left, right\)"):
        read_calibration(tmp_path / "other.yaml")
    with pytest.raises(InputError, match=r"my_right\.yaml' does not exist"):
        read_calibration(tmp_path / "my_left.yaml")
    (tmp_path / "other.yaml").write_text(ROS.replace("TAG", tag).replace("SHIFT", "-84").replace("640", "641"))
    with pytest.raises(InputError, match=r"640 x 480 pixels, .* of 641 x 480; expected one size"):
        read_ros_calibration(tmp_path / "my_left.yaml", tmp_path / "other.yaml")


def test_two_focal_lengths_are_no_rectified_pair(tmp_path):
    text = kitti_2015(CAMERA).replace(f"P_rect_03: {700.5:.12e}", f"P_rect_03: {705:.12e}")
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=r"700\.5 and 705 px; a rectified pair has one"):
        read_calibration(tmp_path / "a.txt")


def test_k_txt(tmp_path):
    (tmp_path / "K.txt").write_text("700 0 320 0 701 240 0 0 1\n0.12\n")
    assert read_calibration(tmp_path / "K.txt") == Calibration(700.0, 0.12, 320.0, 320.0, fy=701.0, cy=240.0)
    (tmp_path / "K.txt").write_text("700 0 320 0 701 240 0 0 1\n")
    with pytest.raises(InputError, match="expected two lines"):
        read_foundation_stereo_calibration(tmp_path / "K.txt")


@pytest.mark.parametrize(
    "text",
    [
        "\n" * 2**20,
        "\r\n" * 2**19,
        " \n" * 2**19,
        "[" * 2**20,
        "a: [" * 2**18,
        "a: [\n" * 2**17,
        "cam0=[" + "1 " * 2**18,
        "P0: " + "1 " * 2**18,
        "a:\n" * 2**18,
        "- " * 2**19,
        "".join(" " * i + "a:\n" for i in range(1400)),
        "projection_matrix:\n" + "#" * 2**19,
        '{"a":' * 2**17,
        "<a>" * 2**18,
        "!!opencv-matrix" * 2**16,
        "Q: !!opencv-matrix\n" + "rows: \n" * 2**17,
        "\n" * 2**19 + "P1: !!opencv-matrix" + "\n" * 2**18,
        '"' * 2**20,
        "1 " * 2**19,
    ],
    ids=lambda text: repr(text[:20]),
)
def test_no_file_within_the_limit_takes_long(tmp_path, text):
    (tmp_path / "left").write_text(text[: 2**20])
    began = time.process_time()
    assert isinstance(outcome(read_calibration, tmp_path / "left"), str)
    assert time.process_time() - began < 5  # quadratic ones took minutes


def test_xml_with_entities_is_refused(tmp_path):
    (tmp_path / "a.xml").write_text(
        '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><opencv_storage>&a;</opencv_storage>'
    )
    with pytest.raises(InputError, match="no declarations"):
        read_calibration(tmp_path / "a.xml")


@given(st.text(alphabet="ab:- []\n\t#'\"!,%", max_size=60))
def test_yaml_of_any_kind_gives_a_tree_or_one_error(text):
    assert isinstance(outcome(parse_yaml, text), str | list | dict)


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
        (yaml_matrix("Q", 4, 4), "expected 16 numbers for Q, got '1.'"),
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
    for name in ("a.xml", "a.json", "b.json"):
        write_calibration(folder / name, CAMERA, kind="stereokit" if name == "b.json" else "opencv", overwrite=True)
        texts.append((folder / name).read_text())
    texts.append(ROS.replace("TAG", "").replace("SHIFT", "-84"))
    (folder / "damaged").write_bytes(data.draw(damaged([text.encode() for text in texts])))
    assert isinstance(outcome(read_calibration, folder / "damaged"), (str, Calibration))


@needs_shared
def test_real_files():
    real = SHARED / "data" / "real"
    eth3d = read_calibration(real / "eth3d" / "terrace" / "calib.txt")
    assert close(eth3d, Calibration(711.499, 0.0599432, 376.135, 376.135, 713, 434, cy=227.447))
    kitti = read_calibration(real / "kitti2012" / "training" / "calib" / "000027.txt")
    assert kitti.baseline == pytest.approx(0.537, abs=0.001)
    assert kitti.depth(kitti.fx * kitti.baseline) == pytest.approx(1)
