from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from stereokit.calibration import Calibration
from stereokit.cli import bag as command
from stereokit.inference import DisparityResult
from tests.cli.commands import fails, run
from tests.ros.bags import write_bag
from tests.video.videos import picture

CAMERA = Calibration(100.0, 0.2, 47.0, 50.0, width=96, height=64, cy=31.0)
MS = 10**6
TOPICS = ("--left", "/left/image_rect", "--right", "/right/image_rect")


class FakePredictor:
    def __call__(self, left: Any, right: Any) -> DisparityResult:
        return DisparityResult(1 + left[..., 0] / np.float32(8), None, 0.01)


@pytest.fixture(autouse=True)
def predictor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "load_predictor", lambda options: FakePredictor())


@pytest.fixture(params=["bag", "ros1.bag"])
def recorded(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Three pairs 2 ms apart, and a left and two right images alone."""
    images = []
    for number in range(5):
        if number != 1:
            images.append(("left", (100 * number + 50) * MS, picture(number)))
        if number != 3:
            images.append(("right", (100 * number + 52) * MS, picture(number + 50)))
    images.append(("right", 900 * MS, picture(0)))
    return write_bag(tmp_path / request.param, CAMERA, images)


def test_a_bag_becomes_one_of_disparity_and_clouds(
    capsys: pytest.CaptureFixture[str], recorded: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    code, said, err = run(capsys, "bag", recorded, *TOPICS, "--out", out, "--cloud")
    assert (code, said) == (0, f"3 pairs; wrote {out}\n")
    assert "1 left and 2 right images without a partner within 0.005 s" in err
    with AnyReader([out]) as reader:
        found = [(c.topic, reader.deserialize(data, c.msgtype)) for c, _, data in reader.messages()]
    disparities = [message for topic, message in found if topic == "/disparity"]
    clouds = [message for topic, message in found if topic == "/points2"]
    assert len(disparities) == len(clouds) == 3
    for number, message, cloud in zip((0, 2, 4), disparities, clouds, strict=True):
        assert message.header.frame_id == cloud.header.frame_id == "left_optical"
        assert message.header.stamp.nanosec == (100 * number + 50) * MS
        values = np.frombuffer(message.image.data, "<f4").reshape(64, 96)
        expected = 1 + picture(number)[..., 0] / np.float32(8)
        # cx1 - cx0 is 3
        np.testing.assert_allclose(values, expected + 3)
        assert (message.f, message.t, message.image.encoding) == (100, pytest.approx(0.2), "32FC1")
        points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)
        np.testing.assert_allclose(points[:, 2], CAMERA.depth(expected).reshape(-1), rtol=1e-6)
    assert {path.name for path in tmp_path.iterdir()} == {recorded.name, "out"}


def test_bags_that_cannot_be_used_are_one_line(
    capsys: pytest.CaptureFixture[str], recorded: Path, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    (tmp_path / "no.bag").write_text("no bag")
    for arguments, words in (
        ((tmp_path / "nothing", *TOPICS, *out), "does not exist"),
        ((tmp_path / "no.bag", *TOPICS, *out), "can't be read as a bag"),
        ((recorded, "--left", "/l", "--right", "/r", *out), "holds no messages of '/l'; it holds /left/camera_info"),
        ((recorded, *TOPICS, "--tolerance", -1, *out), "--tolerance must be at least 0"),
        ((recorded, *TOPICS, "--out", recorded), "exists already"),
    ):
        assert words in fails(capsys, "bag", *arguments)
        assert not (tmp_path / "out").exists()
    code, _, said = run(capsys, "bag", recorded, *TOPICS, "--tolerance", 0, *out)
    assert code == 2
    assert "4 left and 5 right images without a partner" in said
    assert "no image has a partner of its time" in said
    assert {path.name for path in tmp_path.iterdir()} == {recorded.name, "no.bag"}
