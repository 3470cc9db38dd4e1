import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from stereokit.data import write_image
from stereokit.errors import ConfigError, InputError
from stereokit.video import StereoFrame, StereoVideo, open_stereo_video
from tests.video.videos import HEIGHT, WIDTH, FakeCamera, cut, picture, write_video


def collected(video: StereoVideo) -> tuple[list[StereoFrame], str]:
    """The frames, and what was said at the end."""
    frames = []
    with video:
        try:
            for frame in video:
                frames.append(frame)
        except InputError as error:
            return frames, str(error)
    return frames, ""


def images(count: int, start: int = 0) -> list[Any]:
    return [picture(start + number) for number in range(count)]


@pytest.mark.parametrize(("layout", "axis"), [("side-by-side", 1), ("top-bottom", 0)])
def test_one_file_holds_both_views(tmp_path: Path, layout: Any, axis: int) -> None:
    pairs = [np.concatenate([picture(n), picture(n + 50)], axis) for n in range(4)]
    frames, said = collected(open_stereo_video(write_video(tmp_path / "run.mkv", pairs), layout=layout))
    assert said == ""
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [round(frame.time, 3) for frame in frames] == [0.0, 0.1, 0.2, 0.3]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.left, picture(number))
        np.testing.assert_array_equal(frame.right, picture(number + 50))
        assert frame.left.flags.c_contiguous
        assert frame.skew == 0


def test_two_files_give_every_frame(tmp_path: Path) -> None:
    left = write_video(tmp_path / "left.mkv", images(5))
    right = write_video(tmp_path / "right.mkv", images(5, 50))
    with open_stereo_video(left, right) as video:
        assert (video.length, video.rate, video.live, video.name) == (5, 10, False, "left")
        frames, said = collected(video)
    assert (len(frames), said, video.dropped, video.damaged) == (5, "", 0, 0)
    np.testing.assert_array_equal(frames[4].right, picture(54))


def test_a_folder_is_read_by_its_numbers(tmp_path: Path) -> None:
    for side, start in (("l", 0), ("r", 50)):
        (tmp_path / side).mkdir()
        for number in (9, 10, 11):
            write_image(tmp_path / side / f"f{number}.png", picture(start + number))
    frames, said = collected(open_stereo_video(tmp_path / "l", tmp_path / "r", rate=5))
    assert said == ""
    assert [round(frame.time, 3) for frame in frames] == [0, 0.2, 0.4]
    for number, frame in zip((9, 10, 11), frames, strict=True):
        np.testing.assert_array_equal(frame.left, picture(number))
        np.testing.assert_array_equal(frame.right, picture(50 + number))
    frames, _ = collected(open_stereo_video(tmp_path / "l" / "*.png", layout="side-by-side"))
    np.testing.assert_array_equal(frames[0].left, picture(9)[:, : WIDTH // 2])


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mkv", "ffv1", {}),
        ("a.mp4", "mpeg4", {"movflags": "faststart"}),
        ("a.avi", "mjpeg", {}),
        ("a.webm", "libvpx", {}),
    ],
)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.97])
def test_of_a_truncated_file_the_whole_frames_are_kept(
    tmp_path: Path, name: str, codec: str, options: dict[str, str], share: float
) -> None:
    pairs = [np.concatenate([picture(n), picture(n + 50)], 1) for n in range(12)]
    path = write_video(tmp_path / name, pairs, codec=codec, **options)
    whole, said = collected(open_stereo_video(path, layout="side-by-side"))
    assert (len(whole), said) == (12, "")
    frames, said = collected(open_stereo_video(cut(path, share), layout="side-by-side"))
    assert (8 if share > 0.9 else 0) <= len(frames) < 12
    assert f"ends after {len(frames)}" in said
    assert "whole frames: the file was cut off" in said
    for kept, frame in zip(frames, whole, strict=False):
        np.testing.assert_array_equal(kept.left, frame.left)


def test_a_file_cut_before_its_index_is_refused(tmp_path: Path) -> None:
    path = cut(write_video(tmp_path / "a.mp4", images(4), codec="mpeg4"), 0.9)
    with pytest.raises(InputError, match=r"a\.mp4' can't be read as a video: .*cut off"):
        open_stereo_video(path, layout="side-by-side")


def test_views_of_different_length_are_refused_at_once_or_at_the_end(tmp_path: Path) -> None:
    long = write_video(tmp_path / "l.mp4", images(6), codec="mpeg4")
    short = write_video(tmp_path / "r.mp4", images(4), codec="mpeg4")
    with pytest.raises(InputError, match=r"l\.mp4' has 6 frames, .*r\.mp4' 4; expected two views of one length"):
        open_stereo_video(long, short)
    long, short = (write_video(tmp_path / f"{n}.mkv", images(n)) for n in (6, 4))
    frames, said = collected(open_stereo_video(long, short))
    assert len(frames) == 4
    assert "4.mkv' ends after 4 frames, the other view goes on" in said


def test_views_of_different_rate_or_size_are_refused(tmp_path: Path) -> None:
    ten, twenty = (write_video(tmp_path / f"{rate}.mkv", images(3), rate=rate) for rate in (10, 20))
    with pytest.raises(InputError, match=r"10 frames a second, .* 20; expected two views of one rate"):
        open_stereo_video(ten, twenty)
    small = write_video(tmp_path / "small.mkv", [picture(n, 48, 32) for n in range(3)])
    frames, said = collected(open_stereo_video(ten, small))
    assert (len(frames), said) == (0, "the left view has 96 x 64 pixels, the right one 48 x 32; a pair has one size")
    odd = write_video(tmp_path / "odd.mkv", [picture(n, 95, 64) for n in range(3)])
    _, said = collected(open_stereo_video(odd, layout="side-by-side"))
    assert "95 x 64 pixels, which can't be halved as 'side-by-side'; expected an even width" in said


def test_places_and_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", images(2))
    other = write_video(tmp_path / "b.mkv", images(2))
    for arguments, options, kind, words in (
        ((path,), {}, ConfigError, "say layout='side-by-side' or 'top-bottom'"),
        ((path, other), {"layout": "top-bottom"}, ConfigError, "has no effect on two videos"),
        ((path, path), {}, InputError, "given for both views"),
        ((path, other), {"rate": 5}, ConfigError, "rate=5 has no effect"),
        ((path, other), {"size": (4, 4)}, ConfigError, "has no effect"),
        ((path,), {"layout": "over-under"}, ConfigError, "unknown layout"),
        ((path, "camera:0"), {}, InputError, "no partner in a file"),
        (("nowhere.mp4",), {"layout": "side-by-side"}, InputError, "'nowhere.mp4' does not exist"),
        (("camera:front",), {"layout": "side-by-side"}, InputError, "names no camera"),
        (("camera:/dev/none",), {"layout": "side-by-side"}, InputError, "no camera at camera:/dev/none"),
    ):
        with pytest.raises(kind, match=words):
            open_stereo_video(*arguments, **options)  # type: ignore[arg-type]


def test_an_address_that_nobody_answers_is_one_line_without_its_password() -> None:
    with pytest.raises(InputError, match=r"'rtsp://127\.0\.0\.1:9/left' can't be opened") as caught:
        open_stereo_video("rtsp://me:secret@127.0.0.1:9/left", layout="side-by-side", stall_seconds=1)
    assert "secret" not in str(caught.value)


@contextmanager
def served(data: bytes, *, then: Event) -> Iterator[str]:
    """The address of a server that sends these bytes to one client, and hangs up when told to."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send() -> None:
            client, _ = server.accept()
            with client, suppress(ConnectionError):
                client.sendall(data)
                then.wait(60)

        thread = Thread(target=send)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        finally:
            then.set()
            thread.join()


@pytest.fixture(scope="module")
def transport_stream(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What a network camera sends: a second of frames that hold both views."""
    pairs = [np.concatenate([np.full((64, 96, 3), 10 * n, np.uint8)] * 2, 1) for n in range(25)]
    folder = tmp_path_factory.mktemp("stream")
    return write_video(folder / "a.ts", pairs, codec="mpeg2video", rate=25).read_bytes()


def test_a_stream_of_the_network_is_read_until_its_end(transport_stream: bytes) -> None:
    hang_up = Event()
    with (
        served(transport_stream, then=hang_up) as address,
        open_stereo_video(address, layout="side-by-side", stall_seconds=30) as video,
    ):
        first = next(video)
        assert (video.live, video.rate, first.left.shape) == (True, 25, (64, 96, 3))
        hang_up.set()
        numbers = [round(float(frame.left.mean()) / 10) for frame in [first, *video]]
    # those that came while FFmpeg looked what it is are not kept
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 24


def test_a_stream_of_the_network_that_stalls_is_one_line(transport_stream: bytes) -> None:
    with served(transport_stream, then=Event()) as address:
        frames, said = collected(open_stereo_video(address, layout="side-by-side", stall_seconds=1))
    assert frames
    assert "127.0.0.1" in said
    assert "stalls" in said or "broke off" in said


def live(*cameras: FakeCamera, layout: Any = None, stall_seconds: float = 30) -> StereoVideo:
    return StereoVideo(cameras, layout=layout, live=True, stall_seconds=stall_seconds, name="test")


def test_a_live_source_gives_its_newest_and_counts_what_it_dropped() -> None:
    camera = FakeCamera(views=2)
    video = live(camera)
    camera.give(1)
    first = next(video)
    camera.give(2, 3, 4)
    camera.wait_until_read()
    second = next(video)
    camera.give(5, None)
    camera.wait_until_read()
    last = next(video)
    with pytest.raises(StopIteration):
        next(video)
    for frame, number in ((first, 1), (second, 4), (last, 5)):
        np.testing.assert_array_equal(frame.left, picture(number))
        np.testing.assert_array_equal(frame.right, picture(number + 100))
    assert [frame.index for frame in (first, second, last)] == [0, 1, 2]
    assert [frame.time for frame in (first, second, last)] == [0, 3, 4]
    assert (video.dropped, second.skew) == (2, 0.25)
    assert camera.closed


def test_two_live_sources_are_read_apart() -> None:
    left, right = FakeCamera(), FakeCamera(damaged=3)
    video = live(left, right)
    left.give(1)
    right.give(2)
    frame = next(video)
    np.testing.assert_array_equal(frame.left, picture(1))
    np.testing.assert_array_equal(frame.right, picture(2))
    assert (frame.skew, video.damaged) == (1, 3)
    for camera in (left, right):
        camera.give(None)
    video.close()


def test_a_stall_ends_with_a_clear_error() -> None:
    camera = FakeCamera()
    video = live(camera, layout="side-by-side", stall_seconds=0.02)
    camera.give(1)
    assert next(video).left.shape == (HEIGHT, WIDTH // 2, 3)
    with pytest.raises(InputError, match=r"camera:9 has given no frame for 0\.02 s: it stalls"):
        next(video)
    camera.give(None)
    video.close()


def test_a_camera_that_breaks_off_says_so_after_its_last_frame() -> None:
    camera = FakeCamera()
    video = live(camera, layout="top-bottom")
    camera.give(1, InputError("unplugged"))
    assert next(video).index == 0
    with pytest.raises(InputError, match="unplugged"):
        next(video)
