import json
import re
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereokit.calibration import read_calibration, write_calibration
from stereokit.cameras.boards import CharucoBoard, Checkerboard
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import RigRenderer, board_plane, board_poses, example_rig
from stereokit.cameras.rig import read_rig
from stereokit.data import read_image, write_image
from stereokit.video import open_stereo_video
from stereokit.video.writing import FFV1, VideoWriter
from tests.cli.commands import fails, run
from tests.video.videos import cut

BOARD = Checkerboard(6, 4, 0.03)
WORDS = ("--checkerboard", "6x4", "--square", "30mm")
SIZE = (240, 320)
TRUE = example_rig(size=SIZE)


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Views of a board as folders, as two videos, and as one that holds both."""
    folder = tmp_path_factory.mktemp("views")
    renderer = RigRenderer(TRUE, samples=2, noise=1)
    pairs = []
    for i, pose in enumerate(board_poses(16, near=0.3, far=0.5, wide=0.3, tilt=30)):
        pairs.append(renderer([board_plane(BOARD, *pose)], seed=i))
        for side, view in zip(("left", "right"), pairs[-1], strict=True):
            (folder / side).mkdir(exist_ok=True)
            write_image(folder / side / f"{i:02d}.png", _rgb(view))
    _write_video(folder / "left.mkv", [left for left, _ in pairs])
    _write_video(folder / "right.mkv", [right for _, right in pairs])
    _write_video(folder / "both.mkv", [np.hstack(pair) for pair in pairs])
    return folder


def _rgb(grey):
    return np.repeat(grey[:, :, None], 3, axis=2)


def _write_video(path, frames):
    height, width = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10.0, (width, height))
    for frame in frames:
        writer.write(_rgb(frame))
    writer.release()


def test_a_rig_is_calibrated_and_reported(views, tmp_path, capsys):
    out = tmp_path / "rig.json"
    code, said, _ = run(capsys, "calibrate", views / "left", views / "right", *WORDS, "--out", out)
    assert code == 0
    assert re.search(r"1\d of 16 pairs show the board", said)
    rig = read_rig(out)
    assert rig.baseline == pytest.approx(TRUE.baseline, rel=0.01)
    assert rig.left.fx == pytest.approx(TRUE.left.fx, rel=0.01)
    about = json.loads(out.read_text())["about"]
    assert about["board"]["options"] == "--checkerboard 6x4 --square 30mm"
    assert about["quality"]["rms"] < 0.1
    page = (tmp_path / "rig.html").read_text()
    assert page.count("data:image/jpeg") == 5  # two of the coverage, three examples
    assert page.count("<rect") == 2 * len(about["views"])
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    before = out.read_bytes()
    assert "exists already" in fails(capsys, "calibrate", views / "left", views / "right", *WORDS, "--out", out)
    assert out.read_bytes() == before


@pytest.mark.parametrize("given", [("left.mkv", "right.mkv"), ("both.mkv", "--layout", "side-by-side")])
def test_videos_give_the_same_rig(views, tmp_path, capsys, given):
    places = [views / name if name.endswith("mkv") else name for name in given]
    assert run(capsys, "calibrate", views / "left", views / "right", *WORDS, "--out", tmp_path / "a.json")[0] == 0
    assert run(capsys, "calibrate", *places, *WORDS, "--out", tmp_path / "b.json")[0] == 0
    first, second = read_rig(tmp_path / "a.json"), read_rig(tmp_path / "b.json")
    np.testing.assert_allclose(first.left.matrix, second.left.matrix, rtol=1e-3)
    np.testing.assert_allclose(first.translation, second.translation, atol=1e-4)


def test_what_can_not_be_calibrated_is_one_line(views, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    left, right = views / "left", views / "right"
    for words, message in [
        ((left, right, "--checkerboard", "6x4", "--square", "30"), "'30' has no unit; say 30mm"),
        ((left, right, "--checkerboard", "6x4", "--square", "30feet"), "is no length; expected one such as 25mm"),
        ((left, right, "--checkerboard", "6", "--square", "30mm"), "expected columns x rows"),
        ((left, right, *WORDS, "--marker", "20mm"), "--marker has no effect on a checkerboard"),
        ((left, right, "--charuco", "6x4", "--square", "30mm"), "give --marker"),
        ((left, right, *WORDS, "--every", "2"), "--every has no effect on images"),
        ((left, right, *WORDS, "--layout", "side-by-side"), "has no effect on two places"),
        ((left, *WORDS), "say --layout side-by-side or top-bottom"),
        ((left, right, *WORDS, "--out", "rig.yaml"), "a rig is written as .json"),
        ((left, right, *WORDS, "--out", "absent/rig.json"), "does not exist"),
        ((left, views / "absent", *WORDS), "absent"),
        ((views / "left.mkv", views / "both.mkv", *WORDS), "a pair has one size"),
        (("camera:0", "camera:1", *WORDS), "there is no camera at camera:0"),
    ]:
        assert message in fails(capsys, "calibrate", *words), words
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("swapped", "the views are swapped"),
        ("other board", r"0 of 16 pairs of views show the board \(not used: 16 x no board in the left nor the right"),
        ("tiny", "the baseline is 0.00.* expected 5 mm to 5 m; check the unit"),
        ("partner", "1 image without a partner"),
        ("size", "a camera is calibrated for one size"),
    ],
)
def test_views_that_make_no_rig_are_one_line(views, tmp_path, capsys, change, message):
    places, words = [views / "left", views / "right"], WORDS
    if change == "swapped":
        places.reverse()
    elif change == "other board":
        words = ("--checkerboard", "11x8", "--square", "30mm")
    elif change == "tiny":
        words = ("--checkerboard", "6x4", "--square", "2mm")
    else:
        for side in ("left", "right"):
            (tmp_path / side).mkdir()
            for i in range(2):
                write_image(tmp_path / side / f"{i}.png", np.zeros((64 + i, 64, 3), np.uint8))
        places = [tmp_path / "left", tmp_path / "right"]
        if change == "partner":
            (tmp_path / "right" / "1.png").unlink()
    err = fails(capsys, "calibrate", *places, *words, "--out", tmp_path / "rig.json")
    assert re.search(message, err), err
    assert not (tmp_path / "rig.json").exists()
    assert not (tmp_path / "rig.html").exists()


def test_views_are_rectified_with_their_calibration(views, tmp_path, capsys):
    TRUE.write(tmp_path / "rig.json")
    options = ("--rig", tmp_path / "rig.json", "--out", tmp_path / "out")
    code, said, _ = run(capsys, "rectify", views / "left", views / "right", *options)
    assert code == 0
    assert "16 pairs rectified" in said
    rectification = rectify(TRUE)
    left, right = (read_image(views / side / "03.png") for side in ("left", "right"))
    for side, expected in zip(("left", "right"), rectification(left, right), strict=True):
        np.testing.assert_array_equal(read_image(tmp_path / "out" / side / "03.png"), expected)
    assert read_calibration(tmp_path / "out" / "calibration.json") == rectification.calibration
    mask = read_image(tmp_path / "out" / "valid.png")[:, :, 0] > 0
    np.testing.assert_array_equal(mask, rectification.valid)
    code, _, _ = run(
        capsys, "rectify", views / "both.mkv", "--layout", "side-by-side", *options[:3], tmp_path / "video"
    )
    assert code == 0
    with open_stereo_video(tmp_path / "video" / "left.mkv", tmp_path / "video" / "right.mkv") as video:
        assert (video.rate, video.length) == (10, 16)
        frames = list(video)
    assert [frame.time for frame in frames] == pytest.approx(np.arange(16) / 10, abs=1e-3)
    # lossless, but the views went through another video's colours
    np.testing.assert_allclose(frames[3].right[:, :, 0].astype(int), rectification(left, right)[1][:, :, 0], atol=2)


def test_rectified_videos_keep_sixteen_bits_and_what_is_whole(tmp_path, capsys):
    TRUE.write(tmp_path / "rig.json")
    smooth = cv2.resize(np.random.default_rng(0).random((6, 16, 3)), (640, 240)).astype(np.float32)
    with VideoWriter(tmp_path / "both.mkv", codec="ffv1", pixels="gbrp16le", options=FFV1, tags={}, rate=1) as video:
        for time in range(6):
            video.write(np.rint(smooth * 65535).astype(np.uint16), "rgb48le", time)
    options = ("--layout", "side-by-side", "--rig", tmp_path / "rig.json", "--out")
    assert run(capsys, "rectify", tmp_path / "both.mkv", *options, tmp_path / "out")[0] == 0
    with open_stereo_video(tmp_path / "out" / "left.mkv", tmp_path / "out" / "right.mkv") as rectified:
        frames = list(rectified)
    expected = rectify(TRUE)(smooth[:, :320], smooth[:, 320:])
    assert len(frames) == 6
    for view, wanted in zip((frames[5].left, frames[5].right), expected, strict=True):
        assert view.dtype == np.float32
        # steps of 8 bits are 500 times as large
        np.testing.assert_allclose(view, wanted, atol=1.01 / 65535)
    cut(tmp_path / "both.mkv", 0.6)
    code, said, error = run(capsys, "rectify", tmp_path / "both.mkv", *options, tmp_path / "part")
    assert (code, re.search("ends after 3 of 6 whole frames", error) is not None) == (2, True), error
    assert "3 pairs rectified" in said
    assert sorted(path.name for path in (tmp_path / "part").iterdir()) == [
        *("calibration.json", "left.mkv", "right.mkv", "valid.png")
    ]


def test_calibrations_and_rigs_are_converted_and_scaled(tmp_path, capsys):
    TRUE.write(tmp_path / "rig.json")
    camera = rectify(TRUE).calibration
    write_calibration(tmp_path / "own.json", camera)
    convert = ("calibrate", "convert")
    code, said, _ = run(capsys, *convert, tmp_path / "rig.json", tmp_path / "half.json", "--scale-to", 120, 160)
    assert (code, "a rig for images of 160 x 120 px" in said) == (0, True)
    half = read_rig(tmp_path / "half.json")
    assert half == TRUE.scaled(height=120, width=160)
    # a ray goes through the same place of the resized image, whose borders lie at -0.5
    rays = np.array([[0.2, 0.1, 1.0], [-0.3, 0.05, 1.0]])
    np.testing.assert_allclose(half.right.project(rays) + 0.5, (TRUE.right.project(rays) + 0.5) / 2, rtol=1e-12)
    for kind, name in (
        ("opencv", "a.yml"), ("opencv", "a.xml"), ("ros", "left.yaml"), ("kitti", "k.txt"), ("middlebury", "m.txt"),
        ("foundation_stereo", "K.txt"),
    ):  # fmt: skip
        assert run(capsys, *convert, tmp_path / "own.json", tmp_path / name, "--kind", kind)[0] == 0
        found = read_calibration(tmp_path / name)
        for key in ("fx", "fy", "cx0", "cx1", "cy", "baseline"):
            assert getattr(found, key) == pytest.approx(getattr(camera, key), rel=1e-9)
        assert run(capsys, *convert, tmp_path / name, tmp_path / f"{name}.json")[0] == 0
    assert (tmp_path / "right.yaml").exists()
    # of K.txt, which says no size
    for options, words in (
        ((tmp_path / "K.txt", "new.json", "--scale-to", 120, 160), "does not say the size of its images"),
        ((tmp_path / "own.json", "new.json", "--size", 120, 160), "--size has no effect on a file that says it"),
        ((tmp_path / "own.json", "new.json", "--scale-to", 120, 100), "another aspect ratio"),
        ((tmp_path / "rig.json", "new.json", "--scale-to", 120, 100), "another aspect ratio"),
        ((tmp_path / "own.json", "new.json", "--unit", "mm"), "is in metres"),
        ((tmp_path / "rig.json", "new.json", "--kind", "ros"), "--kind has no effect on a rig"),
        ((tmp_path / "own.json", tmp_path / "rig.json"), "exists already"),
    ):
        assert words in fails(capsys, *convert, *options)
    sized = ("--size", 240, 320, "--scale-to", 120, 160)
    assert run(capsys, *convert, tmp_path / "K.txt", tmp_path / "sized.json", *sized)[0] == 0
    assert read_calibration(tmp_path / "sized.json") == camera.scaled(height=120, width=160)


def test_a_calibration_in_millimetres_is_refused_until_it_is_said(tmp_path, capsys):
    camera = replace(rectify(TRUE).calibration, baseline=60.0)
    write_calibration(tmp_path / "mm.yml", camera)
    assert "baseline is 60 m, expected 5 mm to 5 m; if the file has another unit" in fails(
        capsys, "calibrate", "convert", tmp_path / "mm.yml", tmp_path / "m.json"
    )
    assert run(capsys, "calibrate", "convert", tmp_path / "mm.yml", tmp_path / "m.json", "--unit", "mm")[0] == 0
    assert read_calibration(tmp_path / "m.json").baseline == pytest.approx(0.06)


def test_views_of_another_size_are_not_rectified(views, tmp_path, capsys):
    example_rig().write(tmp_path / "rig.json")
    options = ("--rig", tmp_path / "rig.json", "--out", tmp_path / "out")
    for places in (
        (views / "left" / "00.png", views / "right" / "00.png"),
        (views / "left.mkv", views / "right.mkv"),
    ):
        error = fails(capsys, "rectify", *places, *options)
        assert "the left view has 320 x 240 pixels; the rig is for 640 x 480" in error
        assert not (tmp_path / "out").exists()
    (tmp_path / "bad.json").write_text('{"format": "stereokit rig", "version": 1, "left": {"fx": 3}}')
    assert "fy" in fails(capsys, "rectify", *places, "--rig", tmp_path / "bad.json")


@pytest.mark.parametrize("kind", ["checkerboard", "charuco"])
def test_a_board_is_printed_in_true_size(tmp_path, capsys, kind):
    words = (f"--{kind}", "9x6", "--square", "25mm", *(("--marker", "18mm") if kind == "charuco" else ()))
    for suffix in ("pdf", "png"):
        code, said, _ = run(capsys, "calibrate", "board", *words, "--out", tmp_path / f"board.{suffix}")
        assert code == 0
        assert " ".join(words) in said
    stream = re.search(rb"stream\n(.*?)\nendstream", (tmp_path / "board.pdf").read_bytes(), re.DOTALL)[1]
    boxes = [line.split() for line in zlib.decompress(stream).decode().splitlines() if line.endswith(" re")]
    sides = [float(box[2]) * 25.4 / 72 for box in boxes]
    assert sides[0] == pytest.approx(25, abs=1e-3)
    assert max(sides) == pytest.approx(100, abs=1e-3)  # the ruler
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (2480, 3508)
    board = CharucoBoard(9, 6, 0.025, 0.018) if kind == "charuco" else Checkerboard(9, 6, 0.025)
    found = board.find(cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
    assert len(found.ids) == len(board.points)
    across = found.points[board.columns - (2 if kind == "charuco" else 1)] - found.points[0]
    count = board.columns - (2 if kind == "charuco" else 1)
    assert np.linalg.norm(across) * 4 / 300 * 25.4 == pytest.approx(count * 25, rel=2e-3)
    assert b"pHYs" in (tmp_path / "board.png").read_bytes()[:64]


def test_boards_that_can_not_be_printed_are_one_line(tmp_path, capsys):
    words = ("calibrate", "board", "--checkerboard", "9x6", "--square", "25mm")
    for more, message in [
        (("--paper", "a9"), "unknown paper 'a9'"),
        (("--paper", "200x150mm"), "does not fit 200x150mm; choose larger paper"),
        (("--out", tmp_path / "board.svg"), "written as .pdf or .png"),
        (("--out", tmp_path / "board.png", "--dpi", "30"), "expected 72 or more"),
    ]:
        assert message in fails(capsys, *words, *more)
    assert "60 markers are needed" in fails(
        capsys,
        "calibrate",
        "board",
        "--charuco",
        "12x10",
        "--square",
        "25mm",
        "--marker",
        "18mm",
        "--dictionary",
        "DICT_4X4_50",
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_rendered_rig_is_one_to_start_with(tmp_path, capsys):
    folder = tmp_path / "rig"
    words = ("--charuco", "9x6", "--square", "30mm", "--marker", "23mm")
    assert run(capsys, "synth", "rig", *words, "--views", "14", "--out", folder)[0] == 0
    out = tmp_path / "rig.json"
    assert run(capsys, "calibrate", folder / "left", folder / "right", *words, "--out", out)[0] == 0
    assert read_rig(out).baseline == pytest.approx(read_rig(folder / "truth.json").baseline, rel=5e-3)
    scene = folder / "scene"
    options = ("--rig", out, "--depth", "npy", "--out", tmp_path / "metres")
    assert run(capsys, "predict", scene / "left.png", scene / "right.png", *options)[0] == 0
    depth, true = np.load(tmp_path / "metres" / "left_depth.npy"), np.load(scene / "depth.npy")
    near = true <= 520 * 0.06 / 20
    assert np.nanmedian(np.abs(depth - true)[near] / true[near]) < 0.01
