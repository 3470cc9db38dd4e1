import json

import numpy as np
import pytest

from stereokit.cameras import read_calibration
from stereokit.cameras.rig import Camera, Rig, read_rig
from stereokit.errors import InputError

KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.999997, 0.002312, 0.000380, -0.110074]
  - [-0.002317, 0.999898, 0.014090, 0.000400]
  - [-0.000347, -0.014091, 0.999901, -0.000853]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, -0.0001, -3.6e-05]
  distortion_model: radtan
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
RIG = Rig(
    Camera(520.0, 521.0, 320.5, 240.25, 640, 480, (-0.1, 0.02, 1e-4, -1e-4)),
    Camera(522.0, 523.0, 318.5, 238.25, 640, 480, (-0.1, 0.02, 1e-4, -1e-4, 0.01)),
    tuple(np.eye(3).ravel().tolist()),
    (-0.06, 0.001, -0.0005),
)


def test_kalibr_maps_the_first_camera_to_the_second(tmp_path):
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    rig = read_rig(tmp_path / "camchain.yaml")
    assert rig.translation == (-0.110074, 0.0004, -0.000853)
    assert rig.rotation[:3] == (0.999997, 0.002312, 0.00038)
    assert rig.left == Camera(458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28, 0.07, 0.0002, 1.7e-05))
    assert rig.right.matrix[1].tolist() == [0, 456.134, 255.238]
    assert rig.baseline == pytest.approx(0.110078, abs=1e-6)
    with pytest.raises(InputError, match="Kalibr camchain, of cameras that are not rectified"):
        read_calibration(tmp_path / "camchain.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("camera_model: pinhole", "camera_model: omni", "cam0 has the camera_model 'omni'"),
        ("radtan", "fov", "distortion_model 'fov'"),
        ("  - [0.0, 0.0, 0.0, 1.0]\n", "", "no T_cn_cnm1 of 4 x 4"),
        ("[752, 480]", "[752]", "expected 2 numbers for resolution of cam0"),
        ("-0.110074", "0.110074", "views are swapped"),
        ("-0.110074", "-110.074", "baseline is 110.074 m; expected 5 mm to 5 m"),
        ("0.000400", "0.400", "one above the other"),
        ("0.999997", "0.9", "R is no rotation"),
        ("cam1:\n", "cam2:\n", "is no rig"),
        ("[458.654", "[0", "focal lengths and size must be positive"),
    ],
)
def test_malformed_camchains(tmp_path, old, new, message):
    assert old in KALIBR
    (tmp_path / "camchain.yaml").write_text(KALIBR.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        read_rig(tmp_path / "camchain.yaml")
    assert "camchain.yaml" in str(caught.value)


def test_own_file(tmp_path):
    RIG.write(tmp_path / "rig.json", about={"board": "9 x 6"})
    assert read_rig(tmp_path / "rig.json") == RIG
    values = json.loads((tmp_path / "rig.json").read_text())
    for change, message in [
        ({"version": 9}, "has version 9"),
        ({"left": None}, "no camera 'left'"),
        ({"rotation": [1]}, "expected 9 numbers for rotation"),
        ({"left": {**values["left"], "model": "omni"}}, "'pinhole' or 'fisheye', got 'omni'"),
        ({"left": {**values["left"], "distortion": [1, 2]}}, "0, 4, 5, 8, 12, 14 coefficients of distortion, got 2"),
        ({"left": {**values["left"], "image_size": [10, 10]}}, "10 x 10 pixels, the right one of 640 x 480"),
    ]:
        (tmp_path / "bad.json").write_text(json.dumps({**values, **change}))
        with pytest.raises(InputError, match=message):
            read_rig(tmp_path / "bad.json")
    with pytest.raises(InputError, match=r"a rig is written as \.json"):
        RIG.write(tmp_path / "rig.yaml")
