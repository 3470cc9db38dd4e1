import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.calibration import Calibration
from stereokit.cameras.cloud import point_cloud
from stereokit.errors import InputError
from stereokit.inference import DisparityResult
from stereokit.ros import StampPairs, calibration_of, cloud_fields, disparity_fields, rgb_of
from tests.ros.bags import camera_info, image

CAMERA = Calibration(100.0, 0.2, 47.0, 50.0, width=96, height=64, cy=31.0, fy=101.0)
RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


def message(encoding: str, samples: Any, padding: int = 0, big: bool = False) -> Any:
    """An image message whose rows have bytes behind them."""
    height, width = samples.shape[:2]
    rows = np.ascontiguousarray(samples).reshape(height, -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=data.shape[1], is_bigendian=big, data=data.tobytes()
    )


@pytest.mark.parametrize("padding", [0, 5])
def test_encodings(padding: int) -> None:
    alpha = np.dstack([RGB, RGB[..., :1]])
    grey = RGB[..., 0]
    for encoding, samples in (
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("8UC3", RGB[..., ::-1]),
        ("rgba8", alpha),
        ("bgra8", alpha[..., [2, 1, 0, 3]]),
    ):
        np.testing.assert_array_equal(rgb_of(message(encoding, samples, padding)), RGB)
    for found in (
        rgb_of(message("mono8", grey, padding)),
        rgb_of(message("mono16", grey.astype("<u2") * 256 + 9, padding)),
        rgb_of(message("mono16", (grey.astype(np.uint16) * 256 + 9).astype(">u2"), padding, big=True)),
    ):
        np.testing.assert_array_equal(found, np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GBRG", "GRBG"])
def test_bayer_patterns_keep_the_colour(pattern: str) -> None:
    color = np.array([200, 120, 40], np.uint8)
    mosaic = np.tile(np.array([color["RGB".index(letter)] for letter in pattern]).reshape(2, 2), (4, 5))
    found = rgb_of(message(f"bayer_{pattern.lower()}8", mosaic))
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.broadcast_to(color, (4, 6, 3)))


def test_compressed_images() -> None:
    _, data = cv2.imencode(".png", RGB[..., ::-1])
    np.testing.assert_array_equal(rgb_of(SimpleNamespace(format="rgb8; png compressed", data=data.reshape(-1))), RGB)
    with pytest.raises(InputError, match="'jpeg' can't be decoded"):
        rgb_of(SimpleNamespace(format="jpeg", data=b"broken"))


def test_images_that_cannot_be_read() -> None:
    with pytest.raises(InputError, match="encoding 'yuv422' can't be read; expected mono8"):
        rgb_of(message("yuv422", RGB))
    short = message("rgb8", RGB)
    short.data = short.data[:-1]
    with pytest.raises(InputError, match="8 x 6 px, rgb8, has 143 bytes in rows of 24"):
        rgb_of(short)


def test_camera_info_gives_the_calibration() -> None:
    infos = camera_info(CAMERA, "left"), camera_info(CAMERA, "right")
    found = calibration_of(*infos)
    assert (found.fx, found.fy, found.cx0, found.cx1, found.cy) == (100, 101, 47, 50, 31)
    assert found.baseline == pytest.approx(0.2)
    old = [SimpleNamespace(P=i.p, width=96, height=64, binning_x=0, binning_y=0, roi=i.roi) for i in infos]
    assert calibration_of(*old) == found
    with pytest.raises(InputError, match="baseline"):
        calibration_of(*reversed(infos))
    infos[1].p[:] = 0
    with pytest.raises(InputError, match="not calibrated"):
        calibration_of(*infos)


def test_the_offset_is_in_the_disparity_once() -> None:
    disparity = np.random.default_rng(0).uniform(-5, 40, (64, 96)).astype(np.float32)
    disparity[:3] = np.nan
    fields = disparity_fields(disparity, CAMERA)
    depth = CAMERA.depth(disparity)
    known = np.isfinite(depth)
    assert (fields["values"][~known] < fields["min_disparity"]).all()
    np.testing.assert_allclose(fields["f"] * fields["t"] / fields["values"][known], depth[known], rtol=1e-4)
    assert fields["max_disparity"] == fields["values"].max()


def table_of(fields: Any) -> Any:
    """The points of a PointCloud2, by its own description of them."""
    names, offsets = [field[0] for field in fields["fields"]], [field[1] for field in fields["fields"]]
    formats = ["<u4" if name == "rgb" else "<f4" for name in names]
    kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": fields["point_step"]})
    return np.frombuffer(fields["data"].tobytes(), kind)


def test_a_cloud_is_read_back() -> None:
    disparity = np.random.default_rng(0).uniform(5, 40, (64, 96)).astype(np.float32)
    picture = np.random.default_rng(1).integers(0, 256, (64, 96, 3), np.uint8)
    cloud = point_cloud(disparity, CAMERA, picture, confidence=disparity / 40)
    fields = cloud_fields(cloud)
    table = table_of(fields)
    np.testing.assert_array_equal(np.stack([table["x"], table["y"], table["z"]], 1), cloud.points)
    np.testing.assert_array_equal(table["confidence"], cloud.confidence)
    np.testing.assert_array_equal(table["rgb"] >> 16 & 255, cloud.colors[:, 0])
    np.testing.assert_array_equal(table["rgb"] & 255, cloud.colors[:, 2])
    assert fields["row_step"] == fields["data"].size


def test_the_node_turns_messages_into_the_fields_of_its_own() -> None:
    node = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "ros2_node.py"))
    views = [np.full((64, 96, 3), shade, np.uint8) for shade in (90, 20)]
    messages = *(image(view, 0) for view in views), *(camera_info(CAMERA, side) for side in ("left", "right"))

    def predict(left: Any, right: Any) -> DisparityResult:
        return DisparityResult(np.full((64, 96), left.mean() - right.mean(), np.float32), None, 0.0)

    disparity, cloud = node["disparity_and_cloud"](predict, messages)
    assert (disparity["values"] == 73).all()
    np.testing.assert_allclose(table_of(cloud)["z"], 100 * 0.2 / 73, rtol=1e-6)


@given(
    left=st.lists(st.integers(0, 300), unique=True).map(sorted),
    right=st.lists(st.integers(0, 300), unique=True).map(sorted),
    tolerance=st.integers(0, 20),
)
def test_pairs_are_within_the_tolerance_and_nothing_is_lost(left: list[int], right: list[int], tolerance: int) -> None:
    pairs: StampPairs[int] = StampPairs(tolerance)
    sides: list[tuple[int, Literal["left", "right"]]] = [(t, "left") for t in left]
    sides += [(t, "right") for t in right]
    found = [pair for t, side in sorted(sides) if (pair := pairs.add(side, t, t)) is not None]
    alone = pairs.finish()
    assert all(abs(a - b) <= tolerance for a, b in found)
    for place, side, stamps in ((0, "left", left), (1, "right", right)):
        used = [pair[place] for pair in found]
        assert len(set(used)) == len(used)
        assert set(used) <= set(stamps)
        assert len(used) + alone[side] == len(stamps)
    # stamps that are equal on both sides meet, where nothing else is near
    spread = {t for t in set(left) & set(right) if all(abs(t - u) > tolerance for u in {*left, *right} - {t})}
    assert spread <= {a for a, b in found if a == b}
