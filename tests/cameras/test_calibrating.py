import json
from dataclasses import replace

import numpy as np
import pytest

from stereokit.cameras.boards import CharucoBoard, Checkerboard, Corners
from stereokit.cameras.calibrating import BoardView, calibrate_rig, find_board, marker_warning
from stereokit.cameras.calibration_quality import epipolar_rms
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rig import read_rig
from stereokit.errors import InputError
from tests.cameras.rendered_rig import (
    SIZE,
    charuco_texture,
    checkerboard_texture,
    inside,
    poses,
    project,
    rays,
    render,
    rig,
    to_camera,
)

BOARD = Checkerboard(9, 6, 0.025)


def views(of, count=45, noise=0.04, board=BOARD, seed=0, **where):
    """The corners of a board as a detector would give them."""
    rng = np.random.default_rng(seed)
    found = []
    for i, (turn, centre) in enumerate(poses(count, seed=seed, **where)):
        points = [
            project(getattr(of, side), board.points, *to_camera(of, side, turn, centre)) for side in ("left", "right")
        ]
        if all(inside(side).all() for side in points):
            noisy = [side + rng.normal(0, noise, side.shape) for side in points]
            found.append(BoardView(f"view {i}", board.points, *noisy))
    return found


def volume(of, near=0.4, far=5.0, count=400):
    """Points all over what both cameras see, as views without noise."""
    rng = np.random.default_rng(5)
    depth = near * (far / near) ** rng.random(count)
    places = np.stack([*(depth * rng.uniform(-1, 1, (2, count)) * np.array([[0.6], [0.45]])), depth], axis=1)
    centred = places - places.mean(axis=0)
    points = [
        project(getattr(of, side), centred, *to_camera(of, side, np.eye(3), places.mean(axis=0)))
        for side in ("left", "right")
    ]
    seen = inside(points[0], 1) & inside(points[1], 1)
    return BoardView("volume", places[seen], points[0][seen], points[1][seen])


def test_a_pinhole_rig_is_found(tmp_path):
    true = rig()
    found = calibrate_rig(views(true), SIZE)
    assert found.rejected == ()
    assert found.quality.rms < 0.1
    assert found.quality.held_out_rms < 1.5 * found.quality.epipolar_rms
    assert found.rig.baseline == pytest.approx(true.baseline, rel=1e-3)
    for side in ("left", "right"):
        assert getattr(found.rig, side).fx == pytest.approx(getattr(true, side).fx, rel=1e-3)
    # rows and depth at places where no board was
    points = volume(true)
    rectification = rectify(found.rig)
    assert epipolar_rms(rectification, found.rig, [points]) < 0.05
    assert set(found.view_errors) == {view.name for view in views(true)}
    found.rig.write(tmp_path / "rig.json", about=found.to_dict())
    assert read_rig(tmp_path / "rig.json") == found.rig
    assert json.loads((tmp_path / "rig.json").read_text())["about"]["quality"]["views"] == found.quality.views


def test_poor_views_are_found_exactly():
    good = views(rig())
    bad = [
        replace(view, right=view.right + np.array([0.0, 3.0])) if i in (4, 17) else view for i, view in enumerate(good)
    ]
    found = calibrate_rig(bad, SIZE)
    assert sorted(found.rejected) == sorted([good[4].name, good[17].name])
    without = calibrate_rig([view for i, view in enumerate(good) if i not in (4, 17)], SIZE)
    # as if they had never been there
    for side in ("left", "right"):
        np.testing.assert_allclose(getattr(found.rig, side).matrix, getattr(without.rig, side).matrix, atol=1e-4)
    np.testing.assert_allclose(found.rig.translation, without.rig.translation, atol=1e-7)
    few = calibrate_rig(bad, SIZE, least_views=len(bad) - 1)
    assert len(few.rejected) == 1


def test_a_fisheye_rig_is_found():
    true = rig("fisheye")
    found = calibrate_rig(views(true, count=60, near=0.2, far=0.5, wide=1.3), SIZE, model="fisheye")
    assert found.rig.left.model == "fisheye"
    assert found.quality.rms < 0.1
    assert found.rig.baseline == pytest.approx(true.baseline, rel=2e-3)
    assert found.rig.left.fx == pytest.approx(true.left.fx, rel=2e-3)
    assert epipolar_rms(rectify(found.rig), found.rig, [volume(true)]) < 0.15


def test_fisheye_views_of_different_numbers_are_refused():
    some = views(rig("fisheye"), count=12)
    short = replace(some[0], object_points=some[0].object_points[:20], left=some[0].left[:20], right=some[0].right[:20])
    with pytest.raises(InputError, match="use a checkerboard that each view shows wholly"):
        calibrate_rig([short, *some[1:]], SIZE, model="fisheye")


def test_what_is_no_rig_is_refused():
    good = views(rig())
    swapped = [replace(view, left=view.right, right=view.left) for view in good]
    with pytest.raises(InputError, match="the views are swapped"):
        calibrate_rig(swapped, SIZE)
    with pytest.raises(InputError, match="7 views of the board; expected at least 8"):
        calibrate_rig(good[:7], SIZE)
    with pytest.raises(InputError, match="4, 5 or 8 coefficients, got 3"):
        calibrate_rig(good, SIZE, coefficients=3)
    huge = [replace(view, object_points=view.object_points * 100) for view in good]
    with pytest.raises(InputError, match="expected 5 mm to 5 m; check the unit"):
        calibrate_rig(huge, SIZE)
    with pytest.raises(InputError, match=r"can't be solved for|rectify|rig"):
        calibrate_rig([good[0]] * 10, SIZE)


def test_warnings_say_what_to_do():
    true = rig()
    flat = calibrate_rig(views(true, near=0.6, far=0.7, tilt=3.0, wide=0.2), SIZE).warnings
    for words in ("of the left image", "tilted by", "show it at distances that differ"):
        assert any(words in warning for warning in flat), flat
    noisy = calibrate_rig(views(true, noise=0.8), SIZE).warnings
    assert any("expected 0.5 or less" in warning for warning in noisy), noisy
    all_over = calibrate_rig(views(true, count=120, near=0.3, far=0.9, wide=0.95), SIZE)
    assert not any("tilted" in warning or "distances" in warning for warning in all_over.warnings)


def test_why_a_view_can_not_be_used():
    blank = np.full(SIZE, 128, np.uint8)
    assert find_board(BOARD, blank, blank, "a") == "no board in the left nor the right view"
    with pytest.raises(InputError, match="pair 'a': the left view has 640 x 480 pixels, the right one 640 x 479"):
        find_board(BOARD, blank, blank[1:], "a")

    class Seen(CharucoBoard):
        ids = np.arange(7)

        def find(self, grey):
            return Corners(self.ids, np.random.default_rng(0).random((len(self.ids), 2)))

    board = Seen(9, 11, 0.03, 0.02)
    assert find_board(board, blank, blank, "a") == "fewer than 8 corners are seen in both views"
    Seen.ids = np.arange(8)
    assert find_board(board, blank, blank, "a") == "the corners seen in both views lie in a line"
    Seen.ids = np.arange(9)
    assert isinstance(find_board(board, blank, blank, "a"), BoardView)


def test_small_markers_are_warned_of():
    far = views(rig(), board=BOARD, near=0.8, far=1.2)
    board = CharucoBoard(10, 7, 0.025, 0.016)
    assert "use larger markers" in marker_warning(board, far)
    assert marker_warning(CharucoBoard(10, 7, 0.025, 0.024), views(rig(), near=0.3, far=0.35, wide=0.4)) is None
    assert marker_warning(BOARD, far) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("board", "texture", "most"),
    [(BOARD, checkerboard_texture, 0.06), (CharucoBoard(9, 6, 0.03, 0.023), charuco_texture, 0.1)],
    ids=["checkerboard", "charuco"],
)
def test_a_rendered_rig_from_pictures_to_depth(board, texture, most):
    true, rng = rig(), np.random.default_rng(0)
    directions = {side: rays(true, side) for side in ("left", "right")}
    pattern = texture(board)
    found = []
    for i, (turn, centre) in enumerate(poses(36, near=0.3, far=0.8)):
        pictures = [
            render(directions[side], *pattern, *to_camera(true, side, turn, centre), rng) for side in ("left", "right")
        ]
        found.append(find_board(board, *pictures, f"view {i}"))
    usable = [view for view in found if isinstance(view, BoardView)]
    assert len(usable) >= 15
    result = calibrate_rig(usable, SIZE)
    assert result.quality.rms < 0.1
    assert result.rig.baseline == pytest.approx(true.baseline, rel=1e-3)
    assert result.rig.left.fx == pytest.approx(true.left.fx, rel=1e-3)
    points = volume(true)
    assert epipolar_rms(rectify(result.rig), result.rig, [points]) < most
