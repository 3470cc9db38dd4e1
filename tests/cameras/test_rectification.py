from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereokit.cameras.calibration_quality import epipolar_rms
from stereokit.cameras.checking import check_pair
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import RigRenderer, example_rig, example_scene, rectified_depth
from stereokit.cameras.rig import Camera, Rig
from stereokit.errors import InputError
from tests.cameras.rendered_rig import SIZE, volume


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
@pytest.mark.parametrize("view", [None, 70.0])
def test_points_lie_in_one_row_and_at_their_depth(model, view):
    true = example_rig(model)
    points = volume(true)
    rectification = rectify(true, field_of_view=view)
    camera = rectification.calibration
    assert epipolar_rms(rectification, true, [points]) < 1e-4  # what undoing the lens is exact to
    assert camera.baseline == pytest.approx(true.baseline)
    assert camera.cx0 == camera.cx1
    if view is not None:
        assert camera.fx == pytest.approx(320 / np.tan(np.radians(view / 2)))
        assert (camera.cx0, camera.cy) == (319.5, 239.5)
    matrix = np.array([[camera.fx, 0, camera.cx0], [0, camera.fy, camera.cy], [0, 0, 1]])
    module = cv2.fisheye if model == "fisheye" else cv2
    columns = []
    for side, turn in (("left", rectification.left_rotation), ("right", rectification.right_rotation)):
        lens = getattr(true, side)
        seen = getattr(points, side).reshape(-1, 1, 2)
        columns.append(module.undistortPoints(seen, lens.matrix, lens.coefficients, R=turn, P=matrix)[:, 0, 0])
    depth = (points.object_points @ rectification.left_rotation.T)[:, 2]
    np.testing.assert_allclose(camera.depth(columns[0] - columns[1]), depth, rtol=1e-3)


def test_a_rendered_scene_is_rectified():
    true = example_rig()
    scene = example_scene(1)
    views = RigRenderer(true, samples=2, noise=1)(scene, seed=0)
    assert check_pair(*views).severity == "unusable"
    rectification = rectify(true)
    left, right = rectification(*views)
    check = check_pair(left, right, rectification.calibration)
    assert check.severity == "good", str(check)
    disparity = rectification.calibration.disparity(rectified_depth(rectification, scene))
    low, high = np.percentile(disparity, (5, 95))
    assert low < check.measured["disparity_median"] < high
    assert rectification.valid.mean() > 0.9
    assert left.shape == (*SIZE, 3)
    with pytest.raises(InputError, match="the right view has 640 x 479 pixels; the rig is for 640 x 480"):
        rectification(views[0], views[1][1:])


def test_the_mask_says_what_was_seen():
    rectification = rectify(example_rig(), alpha=1.0)
    white = np.full(SIZE, 255, np.uint8)
    left, right = rectification(white, white)
    assert 0.5 < rectification.valid.mean() < 1
    np.testing.assert_array_equal(left[rectification.left_valid], 255)
    # half a pixel beyond the border is mixed with black, and rounded
    assert (right[~rectification.right_valid] < 255).mean() > 0.98


def test_what_is_seen_hangs_on_the_match():
    rectification = rectify(example_rig(), alpha=1.0)
    edge = np.nonzero(rectification.right_valid[240])[0].min()
    column = edge + 30
    assert edge > 0
    assert rectification.left_valid[240, column]
    for disparity, seen in ((29.0, True), (31.0, False), (np.nan, True)):
        assert rectification.seen(np.full(SIZE, disparity))[240, column] == seen
    assert not rectification.seen(np.zeros(SIZE))[~rectification.left_valid].any()


def test_rectifications_of_no_use_are_refused():
    true = example_rig()
    with pytest.raises(InputError, match="'pinhole', the right one 'fisheye'"):
        rectify(replace(true, right=example_rig("fisheye").right))
    for change, message in [
        ({"alpha": 2.0}, "alpha lies from 0 to 1"),
        ({"alpha": 0.5, "field_of_view": 80}, "alpha=0.5 has no effect"),
        ({"field_of_view": 180}, "from 1 to 170 degrees"),
        ({"field_of_view": 150}, "see only .* give a smaller field_of_view"),
    ]:
        with pytest.raises(InputError, match=message):
            rectify(true, **change)
    camera = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
    apart = cv2.Rodrigues(np.array([0, 1.2, 0]))[0]  # cameras that look away from each other
    with pytest.raises(InputError, match="rectify: "):
        rectify(Rig(camera, camera, tuple(apart.ravel().tolist()), (-0.1, 0.0, 0.0)))
