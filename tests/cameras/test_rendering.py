import numpy as np
import pytest

from stereokit.cameras.boards import CharucoBoard, Checkerboard
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import Plane, RigRenderer, example_rig, hit, rectified_depth
from stereokit.cameras.targets import board_picture, dark_rectangles
from tests.cameras.rendered_rig import project

SMALL = (60, 80)


def dot(at, size=0.02):
    """A white square in the middle of a black plane."""
    picture = np.zeros((201, 201), np.uint8)
    picture[95:106, 95:106] = 255
    return Plane(picture, 11 / size, np.eye(3), np.array(at))


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.5), (-0.12, 0.08, 0.6)])
def test_a_dot_is_seen_where_the_cameras_project_it(model, at):
    rig = example_rig(model)
    views = RigRenderer(rig, noise=0)([dot(at)], seed=0)
    for side, view in zip(("left", "right"), views, strict=True):
        x, y = project(rig, side, np.array([at]))[0]
        rows, columns = np.nonzero(view > 60)
        near = (abs(rows - y) < 25) & (abs(columns - x) < 25)  # what is around the plane is grey
        weights = view[rows[near], columns[near]].astype(float)
        assert np.average(columns[near], weights=weights) == pytest.approx(x, abs=0.1)
        assert np.average(rows[near], weights=weights) == pytest.approx(y, abs=0.1)


def test_the_nearest_plane_is_seen_wherever_it_stands_in_the_list():
    near = Plane(np.full((20, 20), 250, np.uint8), 100.0, np.eye(3), np.array([0, 0, 0.5]))
    far = Plane(np.full((40, 40), 10, np.uint8), 4.0, np.eye(3), np.array([0, 0, 2.0]))
    renderer = RigRenderer(example_rig(size=SMALL), samples=1, noise=0)
    one, other = renderer([near, far], seed=0), renderer([far, near], seed=0)
    np.testing.assert_array_equal(one, other)
    assert one[0][30, 40] == 250
    assert one[0][2, 2] == 10
    assert hit([near, far], np.array([[0, 0, 1.0], [0.5, 0.5, 1.0]])).tolist() == [0.5, 2.0]


def test_windows_do_not_change_what_is_seen(monkeypatch):
    planes = [dot((0.1, -0.05, 0.4)), dot((-0.3, 0.1, 0.5), 0.3)]
    renderer = RigRenderer(example_rig(size=SMALL), samples=2)
    seen = renderer(planes, seed=3)
    monkeypatch.setattr(RigRenderer, "_window", lambda *_: (slice(None), slice(None)))
    np.testing.assert_array_equal(seen, renderer(planes, seed=3))


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_true_depth_is_that_of_projected_points(model):
    """Points of a plane, projected into the rectified views by hand, lie at the depth and the disparity told."""
    rig = example_rig(model)
    rectification = rectify(rig)
    turn = np.array([[0.9, 0, 0.1], [0, 1, 0], [-0.1, 0, 0.9]])
    turn, _ = np.linalg.qr(turn)
    plane = Plane(np.zeros((60, 60), np.uint8), 60.0, turn * np.sign(np.diag(turn)), np.array([0.1, 0, 1.2]))
    depth = rectified_depth(rectification, [plane])
    camera = rectification.calibration
    places = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2)) @ plane.turn[:, :2].T + plane.centre
    turned = places @ rectification.left_rotation.T
    columns = camera.fx * turned[:, 0] / turned[:, 2] + camera.cx0
    rows = camera.fy * turned[:, 1] / turned[:, 2] + camera.cy
    inside = (columns > 0) & (columns < 639) & (rows > 0) & (rows < 479)
    assert inside.sum() > 20
    found = depth[np.rint(rows[inside]).astype(int), np.rint(columns[inside]).astype(int)]
    np.testing.assert_allclose(found, turned[inside, 2], rtol=5e-3)  # rounded to whole pixels
    assert 0.1 < np.isnan(depth).mean() < 0.9


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("shape", [(6, 4), (5, 3), (5, 5)])
def test_charuco_boards_are_drawn_as_opencv_draws_them(legacy, shape):
    board = CharucoBoard(*(side + 1 for side in shape), 0.03, 0.021, "DICT_4X4_50", legacy=legacy)
    drawn = board_picture(board, 2000)
    size = board.columns * 60, board.rows * 60
    np.testing.assert_array_equal(drawn, board.opencv().generateImage(size, marginSize=0))


def test_edges_within_a_pixel_are_grey():
    board = Checkerboard(3, 3, 0.015)
    drawn = board_picture(board, 100, border=0.005)
    assert drawn.shape == (7, 7)
    assert drawn[0, 0] == 191  # a quarter of it is black
    ink = dark_rectangles(board)
    assert (255 - drawn.astype(float)).sum() / 255 / 1e4 == pytest.approx((ink[:, 2] * ink[:, 3]).sum(), rel=3e-3)
