import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereokit import Predictor
from stereokit.calibration import Calibration
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rig import Camera, Rig
from stereokit.cli import video as command
from stereokit.cli.interrupts import Terminated, end_in_order, finished_before_interrupt
from stereokit.data import write_image
from stereokit.data.inputs import to_pair
from stereokit.files import atomic_path
from stereokit.inference import DisparityResult, match_video
from stereokit.tables import counted
from stereokit.video import StereoFrame, StereoVideo, open_stereo_video
from stereokit.video.file import VideoFile
from stereokit.video.whole_numbers import read_disparity_video, read_map_video
from tests.cli.commands import fails, run
from tests.video.videos import HEIGHT, WIDTH, FakeCamera, cut, picture, write_video
from tests.viewer.scenes import Columns


class FakePredictor:
    """Finds some disparity at once, which depends on both views."""

    device, scale, backend, rectification = "cpu", 1.0, None, None
    rectified = staticmethod(to_pair)

    def __init__(self) -> None:
        self.after: Callable[[int], None] = lambda matched: None
        self.matched = 0

    def __call__(self, left: Any, right: Any) -> DisparityResult:
        disparity = 1 + left[..., 0] / np.float32(8) + right[..., 1] / np.float32(64)
        self.matched += 1
        self.after(self.matched)
        return DisparityResult(disparity, np.full(disparity.shape, 0.9, np.float32), 0.01)


@pytest.fixture(autouse=True)
def predictor(monkeypatch: pytest.MonkeyPatch) -> FakePredictor:
    fake = FakePredictor()
    monkeypatch.setattr(command, "load_predictor", lambda options: fake)
    return fake


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Five frames, side by side."""
    pairs = [np.concatenate([picture(n), picture(n + 50)], 1) for n in range(5)]
    return write_video(tmp_path / "clip.mkv", pairs)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "calib.json"
    Calibration(80.0, 0.1, 48.0, 48.0, width=WIDTH, height=HEIGHT, cy=32.0).write(path)
    return path


def test_a_video_becomes_disparity_colours_depth_and_clouds(
    capsys: pytest.CaptureFixture[str], clip: Path, calibration: Path, predictor: FakePredictor, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    metres = ("--calibration", calibration, "--depth", "--cloud", "ply", "--every", 2, "--max-depth", 50)
    code, said, shown = run(capsys, "predict", clip, "--layout", "side-by-side", "--out", out, *metres)
    assert code == 0
    names = ["clip_disparity.mkv", "clip_picture.webm", "clip_depth.mkv"]
    clouds = [f"clip_00000{n}_cloud.ply" for n in (0, 2, 4)]
    assert sorted(path.name for path in out.iterdir()) == sorted(names + clouds)
    assert "clip: 5 frames of 96 x 64 px" in said
    assert "3 point clouds" in said
    assert "(1 px is 256 in the disparity)" in said
    assert "dropped" not in said
    assert "5/5" in shown
    with open_stereo_video(clip, layout="side-by-side") as video:
        expected = list(match_video(predictor, video))  # type: ignore[arg-type]
    maps = list(read_disparity_video(out / "clip_disparity.mkv"))
    depths = list(read_map_video(out / "clip_depth.mkv", "depth"))
    camera = Calibration(80.0, 0.1, 48.0, 48.0)
    assert len(maps) == len(depths) == len(list(VideoFile(out / "clip_picture.webm"))) == 5
    for (frame, result), disparity, depth in zip(expected, maps, depths, strict=True):
        assert disparity.time == pytest.approx(frame.time, abs=1e-3)
        np.testing.assert_allclose(disparity.values, result.disparity, atol=1.01 / 256)
        wanted = result.depth(camera, max_depth=50)
        np.testing.assert_array_equal(np.isnan(depth.values), np.isnan(wanted))
        np.testing.assert_allclose(depth.values, wanted, atol=0.0006)
    said = fails(capsys, "predict", clip, "--layout", "side-by-side", "--out", out, *metres)
    assert "exists already" in said


def test_of_a_truncated_file_all_whole_frames_are_written(
    capsys: pytest.CaptureFixture[str], clip: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    code, said, shown = run(capsys, "predict", cut(clip, 0.7), "--layout", "side-by-side", "--out", out)
    assert code == 2
    maps = list(read_disparity_video(out / "clip_disparity.mkv"))
    assert 2 <= len(maps) < 5
    assert f"clip: {len(maps)} frames" in said
    assert f"ends after {len(maps)} of 5 whole frames" in shown
    assert sorted(path.name for path in out.iterdir()) == ["clip_disparity.mkv", "clip_picture.webm"]


def test_videos_that_cannot_be_used_are_one_line(
    capsys: pytest.CaptureFixture[str], clip: Path, images: Path, calibration: Path
) -> None:
    out = images / "out"
    one = ("--out", out)
    for arguments, words in (
        ((clip, *one), "say layout='side-by-side' or 'top-bottom' (--layout)"),
        ((images / "left/a.png", *one), "say layout="),
        ((images / "left/a.png", "--layout", "side-by-side", *one), "is an image, no video"),
        (("camera:/dev/none", "--layout", "side-by-side", *one), "there is no camera at camera:/dev/none"),
        (("camera:/dev/none", "camera:/dev/more", *one), "there is no camera at camera:/dev/none"),
        ((clip, "--layout", "side-by-side", "--every", 2, *one), "--every has no effect without --cloud"),
        ((clip, "--layout", "side-by-side", "--frames", 0, *one), "--frames must be at least 1"),
        ((clip, "--layout", "side-by-side", "--rate", 5, *one), "rate=5 has no effect"),
        (
            (clip, "--layout", "side-by-side", "--depth", "pfm", "--calibration", calibration, *one),
            "say --depth alone, not pfm",
        ),
        ((images / "left", images / "right", "--stall", 3, *one), "--stall has no effect on pairs"),
        ((images / "left", images / "right", "--layout", "top-bottom", *one), "--layout has no effect on two places"),
    ):
        assert words in fails(capsys, "predict", *arguments)
        assert not out.exists()


def test_views_of_a_rig_are_rectified_on_the_way(
    capsys: pytest.CaptureFixture[str], clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = Camera(80.0, 80.0, 47.0, 31.0, WIDTH, HEIGHT, (-0.2, 0.02, 0.0, 0.0))
    rig = Rig(left, left, (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), (-0.1, 0.004, 0.0))
    rig.write(tmp_path / "rig.json")
    seen = []

    class Network(Columns):
        def forward(self, left: Any, right: Any) -> Any:
            seen.append(left)
            return super().forward(left, right)

    predictor = Predictor(Network(), "cpu", rig=tmp_path / "rig.json")
    monkeypatch.setattr(command, "load_predictor", lambda options: predictor)
    out = tmp_path / "out"
    options = ("--layout", "side-by-side", "--rig", tmp_path / "rig.json", "--depth", "--cloud", "--every", 4)
    code, said, _ = run(capsys, "predict", clip, *options, "--out", out)
    assert (code, "clip: 5 frames of 96 x 64 px" in said, "2 point clouds" in said) == (0, True, True)
    rectification = rectify(rig)
    expected, _ = rectification(picture(4), picture(54))
    np.testing.assert_allclose(seen[-1][0].permute(1, 2, 0), expected, atol=1)
    disparity = np.where(np.arange(WIDTH) < 40, 4.0, 8.0) * np.ones((HEIGHT, 1))
    visible = rectification.seen(disparity)
    assert 0 < np.count_nonzero(~visible) < visible.size / 2
    found = list(read_disparity_video(out / "clip_disparity.mkv"))[4].values
    np.testing.assert_array_equal(np.isfinite(found), visible)
    metres = list(read_map_video(out / "clip_depth.mkv", "depth"))[4].values
    wanted = rectification.calibration.depth(disparity)
    np.testing.assert_allclose(metres[visible], wanted[visible], atol=0.0006)
    rig.scaled(height=128, width=192).write(tmp_path / "rig.json", overwrite=True)
    other = Predictor(Columns(), "cpu", rig=tmp_path / "rig.json")
    monkeypatch.setattr(command, "load_predictor", lambda options: other)
    code, _, said = run(capsys, "predict", clip, *options, "--out", tmp_path / "other")
    assert (code, "96 x 64 pixels; the rig is for 192 x 128" in said) == (2, True)
    assert list((tmp_path / "other").iterdir()) == []


def test_a_calibration_of_another_size_leaves_nothing(
    capsys: pytest.CaptureFixture[str], clip: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    Calibration(80.0, 0.1, 96.0, 96.0, width=2 * WIDTH, height=2 * HEIGHT, cy=64.0).write(tmp_path / "c.json")
    code, _, said = run(
        capsys,
        *("predict", clip, "--layout", "side-by-side", "--out", out),
        *("--calibration", tmp_path / "c.json", "--depth"),
    )
    assert code == 2
    assert "the calibration is for images of 192 x 128 pixels, these have 96 x 64" in said
    assert list(out.iterdir()) == []


def test_a_folder_of_frames_with_both_views(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(3):
        write_image(frames / f"{number}.png", picture(number))
    out = tmp_path / "out"
    arguments = ("--layout", "top-bottom", "--rate", 5, "--frames", 2, "--colors", 0, 40, "--disparity-scale", 100)
    code, said, _ = run(capsys, "predict", frames, *arguments, "--out", out)
    assert code == 0
    assert "frames: 2 frames of 96 x 32 px" in said
    assert "1 px is 100" in said
    assert [found.time for found in read_disparity_video(out / "frames_disparity.mkv")] == pytest.approx([0, 0.2])


def test_ctrl_c_ends_a_live_source_in_order(
    capsys: pytest.CaptureFixture[str], predictor: FakePredictor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = FakeCamera(views=2)
    camera.give(1)
    opened = StereoVideo([camera], layout=None, live=True, stall_seconds=60, name="camera_9")
    monkeypatch.setattr(command, "open_stereo_video", lambda *places, **options: opened)

    def press(matched: int) -> None:
        if matched == 3:
            raise KeyboardInterrupt
        camera.give(matched + 1)

    predictor.after = press
    out = tmp_path / "out"
    code, said, _ = run(capsys, "predict", "camera:9", "camera:10", "--out", out)
    camera.give(None)
    assert code == 0
    assert "camera_9: 2 frames of 96 x 64 px" in said
    assert "camera_9: 0 frames dropped" in said
    assert "left and right up to 250 ms apart" in said
    assert len(list(read_disparity_video(out / "camera_9_disparity.mkv"))) == 2


def test_ctrl_c_of_a_file_keeps_what_was_matched(
    capsys: pytest.CaptureFixture[str], clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = command.VideoFiles.add

    def add(self: command.VideoFiles, frame: StereoFrame, *rest: Any) -> None:
        if frame.index == 1:
            # within the writing, which must go on to its end
            os.kill(os.getpid(), signal.SIGINT)
        before(self, frame, *rest)

    monkeypatch.setattr(command.VideoFiles, "add", add)
    out = tmp_path / "out"
    code, said, _ = run(capsys, "predict", clip, "--layout", "side-by-side", "--out", out)
    assert code == 130
    assert "clip: 2 frames" in said
    assert len(list(read_disparity_video(out / "clip_disparity.mkv"))) == 2


@pytest.fixture
def ending_in_order() -> Iterator[None]:
    """Signals as the `stereokit` command has them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_in_order()
    # as nohup has it
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("ending_in_order")
@pytest.mark.parametrize("within", ["matching", "writing"])
def test_a_command_that_is_told_to_end_leaves_whole_files_alone(
    capsys: pytest.CaptureFixture[str],
    clip: Path,
    calibration: Path,
    tmp_path: Path,
    predictor: FakePredictor,
    monkeypatch: pytest.MonkeyPatch,
    within: str,
) -> None:
    write = Path.write_bytes

    def told(self: Path, data: bytes) -> int:
        if self.suffix == ".ply":
            # its temporary file is there by now
            os.kill(os.getpid(), signal.SIGTERM)
        return write(self, data)

    if within == "writing":
        monkeypatch.setattr(Path, "write_bytes", told)
    else:
        predictor.after = lambda matched: os.kill(os.getpid(), signal.SIGTERM) if matched == 3 else None
    out = tmp_path / "out"
    options = ("--calibration", calibration, "--depth", "--cloud", "--every", 9, "--layout", "side-by-side")
    code, said, _ = run(capsys, "predict", clip, *options, "--out", out)
    frames = 1 if within == "writing" else 2
    assert code == 128 + signal.SIGTERM
    assert f"clip: {counted(frames, 'frame')}" in said
    names = ["clip_000000_cloud.ply", "clip_depth.mkv", "clip_disparity.mkv", "clip_picture.webm"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert len(list(read_disparity_video(out / "clip_disparity.mkv"))) == frames


@pytest.mark.usefixtures("ending_in_order")
def test_a_temporary_file_goes_when_the_process_is_told_to_end(tmp_path: Path) -> None:
    def write() -> None:
        with atomic_path(tmp_path / "a.bin") as temporary:
            temporary.write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Terminated):
        write()
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_waits_for_the_end_of_a_block() -> None:
    done = []

    def press() -> None:
        with finished_before_interrupt():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        press()
    assert done == ["whole"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
