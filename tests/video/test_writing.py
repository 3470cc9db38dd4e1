from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.errors import InputError
from stereokit.pictures import colorize
from stereokit.video.colors import ColorVideoWriter, RunningRange
from stereokit.video.file import VideoFile
from stereokit.video.whole_numbers import MapVideoWriter, fitting_scale, read_disparity_video, read_map_video
from tests.video.videos import cut, picture, write_video


@given(
    seed=st.integers(0, 2**31 - 1),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    scale=st.sampled_from([1.0, 64.0, 256.0, 1000.0]),
    lowest=st.sampled_from([0.0, -16.0]),
)
@settings(max_examples=12)
def test_a_map_comes_back_within_half_a_step(
    tmp_path_factory: Any, seed: int, height: int, width: int, scale: float, lowest: float
) -> None:
    rng = np.random.default_rng(seed)
    maps = rng.uniform(lowest, lowest + 65535 / scale, (3, height, width)).astype(np.float32)
    maps[rng.random(maps.shape) < 0.1] = np.nan
    path = tmp_path_factory.mktemp("map") / "a.mkv"
    with MapVideoWriter(path, scale=scale, lowest=lowest) as video:
        for number, values in enumerate(maps):
            video.write(values, 0.04 * number)
    back = list(read_disparity_video(path))
    assert [found.time for found in back] == pytest.approx([0, 0.04, 0.08])
    for values, found in zip(maps, back, strict=True):
        np.testing.assert_array_equal(np.isnan(found.values), np.isnan(values))
        # a step where the value is too small to be told from unknown
        np.testing.assert_allclose(found.values, values, rtol=1e-6, atol=1.001 / scale)
        far = values > lowest + 1 / scale
        np.testing.assert_allclose(found.values[far], values[far], rtol=1e-6, atol=0.501 / scale)
    assert video.lost == 0


def test_what_does_not_fit_is_unknown_and_counted(tmp_path: Path) -> None:
    with MapVideoWriter(tmp_path / "a.mkv") as video:
        video.write(np.array([[-1.0, 0.0, 255.9, 256.0, np.nan, np.inf]]), 0)
    (found,) = read_disparity_video(tmp_path / "a.mkv")
    assert np.isnan(found.values).tolist() == [[True, False, False, True, True, True]]
    assert video.lost == 2


def test_the_scale_that_holds_a_range() -> None:
    for largest in (1, 192, 255.99, 256, 511.9, 512, 3000):
        scale = fitting_scale(largest)
        assert largest * scale <= 65535
        assert scale == 256 or 2 * scale * largest > 65535


def test_a_video_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    with MapVideoWriter(path):
        pass
    assert list(tmp_path.iterdir()) == []
    video = MapVideoWriter(path)
    video.write(np.ones((8, 8)), 0)
    assert not path.exists()
    video.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert len(list(read_disparity_video(path))) == 1
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match="exists already"):
        MapVideoWriter(path)
    with MapVideoWriter(path, overwrite=True) as video:
        for number in range(2):
            video.write(np.ones((8, 8)), number)
        with pytest.raises(InputError, match="holds frames of 8 x 8 pixels, got one of 9 x 8"):
            video.write(np.ones((8, 9)), 2)
    assert len(list(read_disparity_video(path))) == 2


def test_frames_at_one_time_are_kept_apart(tmp_path: Path) -> None:
    with MapVideoWriter(tmp_path / "a.mkv") as video:
        for moment in (0.0, 0.0, 5.0):
            video.write(np.ones((8, 8)), moment)
    assert [found.time for found in read_disparity_video(tmp_path / "a.mkv")] == pytest.approx([0, 0.001, 5])


def test_a_cut_map_video_and_others_are_refused(tmp_path: Path) -> None:
    with MapVideoWriter(tmp_path / "a.mkv", kind="depth", scale=1000) as video:
        for number in range(9):
            video.write(np.random.default_rng(number).random((40, 40)), number)
    with pytest.raises(InputError, match="does not say the scale of its disparity"):
        list(read_disparity_video(tmp_path / "a.mkv"))
    frames = read_map_video(cut(tmp_path / "a.mkv", 0.7), "depth")
    assert [next(frames).time for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match="cut off"):
        list(frames)
    for options, name in (({}, "a.avi"), ({"scale": 0.0}, "b.mkv")):
        with pytest.raises(InputError, match=r"ends in \.mkv|scale must be"):
            MapVideoWriter(tmp_path / name, **options)
    with pytest.raises(InputError, match="does not say"):
        list(read_disparity_video(write_video(tmp_path / "c.mkv", [picture(0)])))


def test_colours_of_a_clip_are_one_range(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(0, 64, 320, dtype=np.float32), (160, 1))
    with ColorVideoWriter(tmp_path / "a.webm", value_range=(0, 64)) as video:
        for number in range(4):
            video.write(ramp, number / 10)
    with av.open(str(tmp_path / "a.webm")) as container:
        assert container.streams.video[0].codec.name == "vp9"
    frames = [shot[0].image for shot in VideoFile(tmp_path / "a.webm")]
    assert len(frames) == 4
    expected = colorize(ramp, value_range=(0, 64)).astype(float)
    assert abs(frames[-1][: ramp.shape[0], : ramp.shape[1]] - expected).mean() < 8


def test_a_small_map_of_growing_range_keeps_its_size(tmp_path: Path) -> None:
    with ColorVideoWriter(tmp_path / "a.webm") as video:
        for number in range(12):
            video.write(np.linspace(0, 10.0 ** (number % 6), 33 * 35).reshape(33, 35), number / 10)
    assert len({shot[0].image.shape for shot in VideoFile(tmp_path / "a.webm")}) == 1


@given(tops=st.lists(st.floats(1, 1000), min_size=1, max_size=12))
def test_a_running_range_stays_within_what_was_seen(tops: list[float]) -> None:
    running = RunningRange()
    maps = [np.linspace(0, top, 200).reshape(10, 20) for top in tops]
    highs = [running.of(values)[1] for values in maps]
    seen = [np.percentile(values, 99) for values in maps]
    assert min(seen) <= min(highs) * (1 + 1e-6)
    assert max(highs) <= max(seen) * (1 + 1e-6)
    for before, after, wanted in zip(highs, highs[1:], seen[1:], strict=False):
        # fast up, slowly down, never past what is wanted
        share = 0.5 if wanted > before else 0.02
        assert after == pytest.approx(before + share * (wanted - before), rel=1e-5)


def test_a_frame_without_disparity_leaves_the_range() -> None:
    running = RunningRange()
    unknown = np.full((4, 6), np.nan)
    assert running.of(unknown) == (0, 1)
    first = running.of(np.linspace(0, 50, 24).reshape(4, 6))
    assert running.of(unknown) == first
