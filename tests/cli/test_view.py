import os
import signal
import socket
import subprocess
import sys
import urllib.request

import numpy as np
import pytest

from stereokit import Predictor
from stereokit.calibration import write_calibration
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rig import Camera, Rig
from stereokit.cli import view as command
from stereokit.data import write_image
from tests.cli.commands import fails, run
from tests.video.videos import write_video
from tests.viewer.scenes import CAMERA, Columns, save_pairs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs")
    save_pairs(folder)
    write_calibration(folder / "camera.json", CAMERA)
    both = np.concatenate([np.zeros((48, 80, 3), np.uint8)] * 2, axis=1)
    (folder / "frames").mkdir()
    for number in range(2):
        write_image(folder / "frames" / f"{number}.png", both)
    return folder


def pair(folder, name="a"):
    return str(folder / f"{name}_left.png"), str(folder / f"{name}_right.png")


def test_a_page_is_written_once(folder, tmp_path, capsys):
    patterns = str(folder / "*_left.png"), str(folder / "*_right.png")
    options = (
        "--disparity",
        folder / "results",
        "--calibration",
        folder / "camera.json",
        "--html",
        tmp_path / "a.html",
    )
    code, said, _ = run(capsys, "view", *patterns, *options)
    assert (code, "wrote" in said) == (0, True)
    size = (tmp_path / "a.html").stat().st_size
    assert f"{size / 1e6:.1f} MB" in said
    assert "exists already" in fails(capsys, "view", *patterns, *options)
    assert run(capsys, "view", *patterns, *options, "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--overwrite",), "--overwrite has no effect without --html"),
        (("--html", "x.html", "--port", "1"), "--port has no effect with --html"),
        (("--disparity", "RESULT", "--scale", "2"), "--scale has no effect with --disparity"),
        (("--disparity", "RESULT", "--device", "cpu"), "--device has no effect with --disparity"),
        (("--disparity", "RESULT", "--rig", "rig.json"), "--rig has no effect with --disparity"),
        (("--disparity", "absent.npz"), "'absent.npz' does not exist"),
        (("--disparity", "RESULT", "--disparity-error", "0"), "must be a positive number of px"),
        (("--calibration", "a", "--rig", "b"), "--calibration has no effect beside --rig"),
        (("--layout", "top-bottom"), "layout='top-bottom' has no effect on two videos"),
    ],
)
def test_options_that_do_nothing_are_refused(folder, capsys, options, words):
    result = str(folder / "results" / "a_disparity.npz")
    given = [result if option == "RESULT" else option for option in options]
    assert words in fails(capsys, "view", *pair(folder), *given)


def test_places_that_can_not_be_viewed(folder, capsys, tmp_path):
    assert "say layout=" in fails(capsys, "view", pair(folder)[0])
    assert "camera:99" in fails(capsys, "view", "camera:99", "--layout", "side-by-side")
    frames = (folder / "frames", "--layout", "side-by-side")
    assert "--html is for pairs" in fails(capsys, "view", *frames, "--html", tmp_path / "a.html")
    assert "--disparity is for pairs" in fails(capsys, "view", *frames, "--disparity", tmp_path)
    other = CAMERA.scaled(height=96, width=160)
    write_calibration(tmp_path / "other.json", other)
    result = folder / "results" / "a_disparity.npz"
    said = fails(capsys, "view", *pair(folder), "--disparity", result, "--calibration", tmp_path / "other.json")
    assert "160 x 96" in said


def test_a_video_of_a_rig_is_rectified_and_has_metres(folder, tmp_path, monkeypatch, capsys):
    camera = Camera(80.0, 80.0, 39.0, 23.0, 80, 48, (-0.2, 0.02, 0.0, 0.0))
    rig = Rig(camera, camera, (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), (-0.1, 0.004, 0.0))
    rig.write(tmp_path / "rig.json")
    views = np.random.default_rng(0).integers(0, 256, (3, 48, 160, 3), np.uint8)
    write_video(tmp_path / "run.mkv", views)
    predictor, desks = Predictor(Columns(), "cpu", rig=tmp_path / "rig.json"), []
    monkeypatch.setattr(command, "load_predictor", lambda options: predictor)
    monkeypatch.setattr(command, "_serve", lambda desk, options: desks.append((desk, desk.next(1))))
    code, _, _ = run(capsys, "view", tmp_path / "run.mkv", "--layout", "side-by-side", "--rig", tmp_path / "rig.json")
    assert code == 0
    [(desk, shot)] = desks
    rectification = rectify(rig)
    for found, expected in zip((shot.left, shot.right), rectification(views[1][:, :80], views[1][:, 80:]), strict=True):
        np.testing.assert_allclose(found, expected, atol=1)
    assert desk.facts()["calibration"] == rectification.calibration.to_dict()
    assert np.isnan(shot.result.disparity).any()
    np.testing.assert_array_equal(
        np.isfinite(shot.result.disparity),
        rectification.seen(np.where(np.arange(80) < 40, 4.0, 8.0) * np.ones((48, 1))),
    )


def test_a_port_in_use_is_one_line(folder, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = folder / "results" / "a_disparity.npz"
        assert f"port {port} is in use" in fails(capsys, "view", *pair(folder), "--disparity", result, "--port", port)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["result", "frames"])
def test_the_page_is_served_until_it_is_interrupted(folder, weights, kind):
    places = [*pair(folder), "--disparity", str(folder / "results" / "a_disparity.npz")]
    if kind == "frames":
        places = [str(folder / "frames"), "--layout", "side-by-side", "--weights", weights]
    command = [sys.executable, "-m", "stereokit", "view", *places, "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        url = running.stdout.readline().split()[0]
        path = "entry?index=0" if kind == "result" else "next?after=-1"
        with urllib.request.urlopen(url + path) as answer:
            assert b'"width": 80' in answer.read()
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors) == (0, "")
