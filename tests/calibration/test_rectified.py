import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.cameras import Calibration
from stereokit.errors import InputError
from tests.calibration.drawn import cameras

CAMERAS = cameras(
    width=st.integers(1, 5000), height=st.integers(1, 5000), fy=st.floats(50, 5000), cy=st.floats(1, 3000)
)


def project(camera, point):
    """x_left, y and x_right, written out."""
    x, y, z = point
    left = camera.cx0 + camera.fx * x / z
    return left, camera.cy + camera.fy * y / z, camera.cx1 + camera.fx * (x - camera.baseline) / z


POINTS = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.5, 50))


@given(CAMERAS, st.floats(0.1, 100))
def test_depth_is_where_the_ray_meets(camera, metres):
    # A point on the left camera's axis at some depth is seen fx * baseline / depth further left in the
    # right view.
    seen_left = camera.cx0
    seen_right = camera.cx1 - camera.fx * camera.baseline / metres
    assert camera.depth(seen_left - seen_right) == pytest.approx(metres, rel=1e-4)


def test_depth_of_the_unknown():
    camera = Calibration(100, 1, 50, 50)
    np.testing.assert_array_equal(camera.depth([[np.nan, np.inf, 0, -1, 50]]), [[np.nan] * 4 + [2]])
    assert camera.depth([[1.0]]).dtype == np.float32
    # With an offset, a disparity of 0 is a depth like any other.
    np.testing.assert_array_equal(Calibration(100, 1, 50, 60).depth([0, -10, -20]), [10, np.nan, np.nan])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0}, "focal length"),
        ({"fx": float("nan")}, "focal length"),
        ({"baseline": -1}, "views are swapped"),
        ({"baseline": float("inf")}, "baseline"),
        ({"cx1": float("nan")}, "principal points"),
        ({"height": 0}, "image size"),
        ({"height": None}, "both sides or neither, got 1 x None"),
        ({"fy": -1}, "focal length"),
        ({"cy": float("inf")}, "principal points"),
    ],
)
def test_impossible_cameras(change, message):
    arguments = {"fx": 1, "baseline": 1, "cx0": 0, "cx1": 0, "width": 1, "height": 1}
    with pytest.raises(InputError, match=message):
        Calibration(**{**arguments, **change})


@given(CAMERAS, st.floats(-50, 50), st.floats(0.1, 100))
def test_disparity_is_the_inverse_of_depth(camera, doffs, metres):
    camera = replace(camera, cx1=camera.cx0 + doffs)
    assert camera.depth(camera.disparity(metres)) == pytest.approx(metres, rel=1e-3)


def test_the_reciprocal_never_gives_what_is_not_finite():
    camera = Calibration(100, 1, 50, 50)
    # depths that no float32 can hold, of disparities that a network can give
    np.testing.assert_array_equal(camera.depth(np.array([1e-45, 1e-38, -0.0])), [np.nan] * 3)
    np.testing.assert_array_equal(camera.disparity([0, -1, np.nan, np.inf]), [np.nan] * 4)


@given(CAMERAS, POINTS, st.integers(1, 3000), st.integers(1, 3000))
def test_scaled_sees_a_point_where_the_resized_images_show_it(camera, point, height, width):
    scaled = camera.scaled(height=height, width=width, stretch=True)
    assert (scaled.height, scaled.width) == (height, width)
    left, row, right = project(camera, point)
    across, down = width / camera.width, height / camera.height
    # the borders of the image, half a pixel from the outermost centres, stay borders
    expected = ((left + 0.5) * across - 0.5, (row + 0.5) * down - 0.5, (right + 0.5) * across - 0.5)
    assert project(scaled, point) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@given(CAMERAS, POINTS, st.data())
def test_cropped_sees_a_point_where_the_window_shows_it(camera, point, data):
    width, height = data.draw(st.integers(1, camera.width)), data.draw(st.integers(1, camera.height))
    top = data.draw(st.integers(0, camera.height - height))
    left, left_of_right = (data.draw(st.integers(0, camera.width - width)) for _ in range(2))
    window = camera.cropped(top=top, left=left, height=height, width=width, left_of_right=left_of_right)
    seen = project(camera, point)
    expected = (seen[0] - left, seen[1] - top, seen[2] - left_of_right)
    assert project(window, point) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    whole = camera.cropped(top=top, left=left, height=height, width=width)
    assert whole.doffs == pytest.approx(camera.doffs)


@given(CAMERAS, POINTS)
def test_mirrored_sees_the_mirrored_point(camera, point):
    left, row, right = project(camera, point)
    mirrored = camera.mirrored()
    # seen from the old right camera, which is the new left one
    x, y, z = point
    seen = project(mirrored, (camera.baseline - x, y, z))
    assert seen == pytest.approx((camera.width - 1 - right, row, camera.width - 1 - left), rel=1e-6, abs=1e-6)
    assert mirrored.mirrored().cx0 == pytest.approx(camera.cx0)


def test_another_aspect_is_refused_but_for_rounding():
    camera = Calibration(700.0, 0.1, 320.0, 320.0, 641, 481)
    assert camera.scaled(width=320, height=240).fx == pytest.approx(700 * 320 / 641)
    assert camera.scaled(width=321, height=241).fy == pytest.approx(700 * 241 / 481)
    with pytest.raises(InputError, match="320 x 200 has another aspect ratio than 641 x 481"):
        camera.scaled(width=320, height=200)
    with pytest.raises(InputError, match="can't be scaled to 0 x 0"):
        camera.scaled(width=0, height=0)
    with pytest.raises(InputError, match=r"use sized\(height, width\) first"):
        Calibration(700.0, 0.1, 320.0, 320.0).scaled(width=3, height=3)


def test_a_window_outside_is_refused():
    camera = Calibration(700.0, 0.1, 320.0, 320.0, 640, 480)
    for window in [(-1, 0, 4, 4), (0, 637, 4, 4), (477, 0, 4, 4), (0, 0, 0, 4), (0, 0, 481, 4)]:
        with pytest.raises(InputError, match="does not lie within 640 x 480"):
            camera.cropped(**dict(zip(("top", "left", "height", "width"), window, strict=True)))
    with pytest.raises(InputError, match="does not lie within"):
        camera.cropped(top=0, left=0, height=4, width=4, left_of_right=637)
    assert Calibration(700.0, 0.1, 320.0, 320.0).cropped(top=0, left=900, height=4, width=4).cx0 == -580


def test_images_of_another_size_are_refused_with_both_sizes():
    camera = Calibration(1400.0, 0.1, 128.0, 128.0, width=256, height=128, cy=64.0)
    camera.check_size(128, 256)
    with pytest.raises(InputError, match=r"256 x 128 pixels, these have 128 x 64; .*scaled\(height=64, width=128\)"):
        camera.check_size(64, 128)
    with pytest.raises(InputError, match=r"these have 200 x 128; they have another aspect ratio"):
        camera.check_size(128, 200)
    # half the size: half the focal length, and a depth that is right
    assert float(camera.scaled(height=64, width=128).depth(20.0)) == pytest.approx(3.5)
    Calibration(1400.0, 0.1, 128.0, 128.0).check_size(64, 128)
    assert not math.isnan(camera.fy)
