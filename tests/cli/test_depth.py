import re
import shutil

import cv2
import numpy as np
import pytest

from stereokit.calibration import Calibration, write_calibration
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import Plane, RigRenderer, example_rig, rectified_depth
from stereokit.cli import main
from stereokit.data import read_pfm, write_image
from stereokit.data.synthetic import SyntheticScenes

SIZE = (96, 160)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    pair = SyntheticScenes(seed=1, size=SIZE, max_disparity=20, photometric=0)[0]
    for name in ("left", "right"):
        write_image(folder / f"{name}.png", getattr(pair, name))
    camera = Calibration(fx=200.0, baseline=0.1, cx0=80.0, cx1=80.0, cy=48.0, height=SIZE[0], width=SIZE[1])
    write_calibration(folder / "camera.json", camera)
    return folder


def predict(scene, tmp_path, *options):
    views = [str(scene / f"{name}.png") for name in ("left", "right")]
    return main(["predict", *views, "--out", str(tmp_path / "out"), *options])


def read_millimetres(tmp_path):
    return cv2.imread(str(tmp_path / "out" / "left_depth.png"), cv2.IMREAD_UNCHANGED)


def test_depth_is_that_of_the_disparity(scene, tmp_path, capsys):
    options = ("--calibration", str(scene / "camera.json"), "--depth", "npy", "--cloud", "--axes", "ros")
    assert predict(scene, tmp_path, *options) == 0
    said = capsys.readouterr().out
    assert "m, median" in said
    assert "points; wrote" in said
    depth = np.load(tmp_path / "out" / "left_depth.npy")
    disparity = read_pfm(tmp_path / "out" / "left_disparity.pfm")
    known = disparity > 0
    np.testing.assert_allclose(depth[known], 20.0 / disparity[known], rtol=1e-5)
    assert (tmp_path / "out" / "left_cloud.ply").stat().st_size > 1000


def test_millimetres_and_filters(scene, tmp_path):
    options = ("--calibration", str(scene / "camera.json"), "--depth", "--min-confidence", "0.5", "--max-depth", "5")
    assert predict(scene, tmp_path, *options, "--left-right") == 0
    depth = read_millimetres(tmp_path)
    assert depth.dtype == np.uint16
    assert 0 < (depth > 0).mean() < 1
    assert depth.max() <= 5000
    filled = predict(scene, tmp_path, *options, "--left-right", "--holes", "background", "--overwrite")
    assert filled == 0
    assert (read_millimetres(tmp_path) > 0).mean() >= (depth > 0).mean()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--max-depth", "5"), "--max-depth has no effect without --depth or --cloud"),
        (("--depth", "--axes", "ros"), "--axes has no effect without --cloud"),
        (("--depth",), "give --calibration FILE, or --rig FILE"),
        (("--depth", "--calibration", "a.json", "--rig", "b.json"), "--calibration has no effect beside --rig"),
        (("--rig", "absent.json"), "absent.json"),
        (("--depth", "--calibration", "absent.json"), "absent.json"),
    ],
)
def test_options_that_do_nothing_are_refused(scene, tmp_path, capsys, options, words):
    assert predict(scene, tmp_path, *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_calibration_of_another_size_is_refused(scene, tmp_path, capsys):
    camera = Calibration(fx=400.0, baseline=0.1, cx0=160.0, cx1=160.0, cy=96.0, height=192, width=320)
    write_calibration(tmp_path / "other.json", camera)
    assert predict(scene, tmp_path, "--calibration", str(tmp_path / "other.json"), "--depth") == 2
    error = capsys.readouterr().err
    assert "320 x 192" in error
    assert "160 x 96" in error


@pytest.fixture(scope="module")
def rig_scene(tmp_path_factory):
    """A plane at 0.4 m before a small rig, and its true depth."""
    folder = tmp_path_factory.mktemp("rig")
    rig = example_rig(size=SIZE, baseline=0.05)
    picture = SyntheticScenes(seed=2, size=(200, 300), max_disparity=4, photometric=0, plain=0, objects=(30, 40))[
        0
    ].left
    plane = Plane(picture, 300 / 0.55, np.eye(3), np.array([0, 0, 0.4]))
    for name, view in zip(("left", "right"), RigRenderer(rig, samples=2, noise=0)([plane], seed=0), strict=True):
        write_image(folder / f"{name}.png", view)
    rig.write(folder / "rig.json")
    return folder, rectified_depth(rectify(rig), [plane])


def test_views_of_a_rig_become_metres(rig_scene, tmp_path, capsys):
    folder, truth = rig_scene
    options = ("--rig", str(folder / "rig.json"), "--depth", "npy", "--cloud", "--left-right")
    assert predict(folder, tmp_path, *options) == 0
    assert re.search(r"^left: \d+ pixels \(\d+\.\d %\) were not seen by both cameras$", capsys.readouterr().err, re.M)
    depth = np.load(tmp_path / "out" / "left_depth.npy")
    both = np.isfinite(depth) & np.isfinite(truth)
    assert both.mean() > 0.5
    assert np.median(np.abs(depth - truth)[both] / truth[both]) < 0.02
    disparity = read_pfm(tmp_path / "out" / "left_disparity.pfm")
    assert np.isfinite(depth).sum() < (disparity > 0).sum() < disparity.size


def test_views_of_another_size_than_the_rig_are_refused(rig_scene, tmp_path, capsys):
    folder, _ = rig_scene
    for name in ("left", "right"):
        shutil.copy(folder / f"{name}.png", tmp_path)
    example_rig(size=(192, 320)).write(tmp_path / "rig.json")
    assert predict(tmp_path, tmp_path, "--rig", str(tmp_path / "rig.json"), "--depth") == 2
    assert "the left view has 160 x 96 pixels; the rig is for 320 x 192" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
