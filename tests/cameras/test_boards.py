import numpy as np
import pytest

from stereokit.cameras.boards import CharucoBoard, Checkerboard, Corners
from stereokit.cameras.rendering import RigRenderer, board_plane, board_poses, example_rig
from stereokit.errors import InputError
from tests.cameras.rendered_rig import inside, placed, project


@pytest.mark.parametrize(
    "board",
    [
        Checkerboard(9, 6, 0.025),
        Checkerboard(7, 5, 0.03),  # looks alike turned around
        CharucoBoard(9, 6, 0.03, 0.022),
        CharucoBoard(8, 6, 0.03, 0.022, legacy=True),
    ],
    ids=["9x6", "7x5", "charuco", "legacy"],
)
def test_corners_are_found_where_they_are(board):
    rig = example_rig()
    renderer = RigRenderer(rig, samples=2)
    errors = []
    for i, pose in enumerate(board_poses(3, near=0.3, far=0.6, tilt=20)):
        found = [board.find(view) for view in renderer([board_plane(board, *pose)], seed=i)]
        true = [project(rig, side, placed(board.points, *pose)) for side in ("left", "right")]
        if isinstance(board, Checkerboard) and not all(inside(points, 15).all() for points in true):
            continue  # only wholly seen ones can be found
        left, right = board.paired(*found)
        np.testing.assert_array_equal(left.ids, right.ids)
        # a board that looks alike may be numbered from its other end, but in both views
        order = slice(None)
        if isinstance(board, Checkerboard) and np.abs(left.points - true[0]).max() > 5:
            order = slice(None, None, -1)
        errors += [
            corners.points - points[order][corners.ids] for corners, points in zip((left, right), true, strict=True)
        ]
    errors = np.concatenate(errors)
    assert (np.abs(errors.mean(axis=0)) < 0.01).all()
    assert np.median(np.abs(errors)) < 0.04
    assert (errors.std(axis=0) < (0.06 if isinstance(board, Checkerboard) else 0.1)).all()


def test_no_board_is_no_board():
    noise = np.random.default_rng(0).integers(0, 256, (120, 160), np.uint8)
    assert Checkerboard(9, 6, 0.025).find(noise) is None
    assert CharucoBoard(9, 6, 0.03, 0.02).find(noise) is None


@pytest.mark.parametrize(("columns", "rows"), [(5, 4), (4, 4)])
def test_the_right_view_is_numbered_as_the_left_one(columns, rows):
    board = Checkerboard(columns, rows, 0.1)
    points = board.points[:, :2] * 100 + np.array([3.0, 7.0])
    left = Corners(np.arange(columns * rows), points)
    for turn in (0, 2) if columns != rows else range(4):
        turned = np.rot90((points + 5).reshape(rows, columns, 2), turn).reshape(-1, 2)
        np.testing.assert_array_equal(board.paired(left, Corners(left.ids, turned))[1].points, points + 5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Checkerboard(2, 6, 0.03), "at least 3 x 3 inner corners, got 2 x 6"),
        (lambda: Checkerboard(9, 6, 30), "is 30 m; expected 0.001 to 2, in metres: 0.03 for squares of 30 mm"),
        (lambda: CharucoBoard(9, 6, 0.03, 0.03), "a marker is smaller than its square"),
        (lambda: CharucoBoard(9, 6, 0.03, 0.02, "DICT_1"), "unknown dictionary 'DICT_1'"),
    ],
)
def test_impossible_boards(make, message):
    with pytest.raises(InputError, match=message):
        make()
