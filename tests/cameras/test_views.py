import numpy as np
import pytest

from stereokit.cameras.boards import CharucoBoard, Checkerboard, Corners
from stereokit.cameras.rendering import RigRenderer, board_plane, board_poses, example_rig
from stereokit.cameras.views import BoardView, ViewPair, find_board, find_views
from stereokit.errors import InputError
from tests.cameras.rendered_rig import SIZE

BOARD = Checkerboard(9, 6, 0.025)
SMALL = (240, 320)


def pictures(board, count=4, **where):
    renderer = RigRenderer(example_rig(size=SMALL), samples=2)
    return [
        ViewPair(f"view {i}", *renderer([board_plane(board, *pose)], seed=i))
        for i, pose in enumerate(board_poses(count, **where))
    ]


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


def test_views_and_reasons_are_counted():
    pairs = pictures(Checkerboard(5, 4, 0.03), near=0.3, far=0.4, wide=0.2, tilt=15)
    blank = np.full((*SMALL, 3), 0.5)
    found = find_views(Checkerboard(5, 4, 0.03), lambda: [*pairs, ViewPair("blank", blank, blank)])
    assert [view.name for view in found.views] == [pair.name for pair in pairs]
    assert found.unused == {"blank": "no board in the left nor the right view"}
    assert found.size == SMALL
    found.check_enough(4)
    with pytest.raises(InputError, match=r"4 of 5 pairs .*1 x no board in the left nor the right.*expected at least 5"):
        found.check_enough(5)


def test_pairs_of_two_sizes_or_none_are_refused():
    blank = np.zeros(SMALL, np.uint8)
    with pytest.raises(InputError, match="'b' has 320 x 239 pixels, pair 'a' 320 x 240; a camera is calibrated for"):
        find_views(BOARD, lambda: [ViewPair("a", blank, blank), ViewPair("b", blank[1:], blank[1:])])
    with pytest.raises(InputError, match="there are no views"):
        find_views(BOARD, lambda: [])


@pytest.mark.parametrize("legacy", [False, True])
def test_the_other_layout_is_found_and_said(legacy):
    board = CharucoBoard(6, 4, 0.04, 0.032, "DICT_4X4_50", legacy=legacy)
    pairs = pictures(board, near=0.35, far=0.4, wide=0.2, tilt=10)
    same = find_views(board, lambda: pairs)
    assert len(same.views) == len(pairs)
    assert same.warnings == ()
    other = find_views(CharucoBoard(6, 4, 0.04, 0.032, "DICT_4X4_50", legacy=not legacy), lambda: pairs)
    assert other.board == board
    assert len(other.views) == len(pairs)
    assert ("before OpenCV 4.6" if legacy else "4.6 and later") in other.warnings[0]


def test_small_markers_are_warned_of():
    board = CharucoBoard(6, 4, 0.04, 0.024, "DICT_4X4_50")
    found = find_views(board, lambda: pictures(board, 2, near=0.45, far=0.5, wide=0.1, tilt=5))
    assert found.views
    assert "use larger markers" in found.warnings[0]
    larger = CharucoBoard(6, 4, 0.04, 0.036, "DICT_4X4_50")
    assert find_views(larger, lambda: pictures(larger, 2, near=0.3, far=0.35, wide=0.1, tilt=5)).warnings == ()
