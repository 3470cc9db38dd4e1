import numpy as np
import pytest

from stereokit.cameras.consistency import occluded, right_disparity
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import InputError

SCENES = SyntheticScenes(seed=3, size=(64, 128), max_disparity=20, photometric=0)


@pytest.mark.parametrize("index", range(4))
def test_the_true_maps_agree_but_where_the_scene_hides(index):
    pair = SCENES[index]
    found = occluded(pair.disparity, pair.right_disparity, tau=1.0)
    # outlines fall between pixels, so a column beside them may go either way
    wrong = found != ~pair.nonocc
    assert wrong.mean() < 0.04
    if (~pair.nonocc).any():
        assert found[~pair.nonocc].mean() > 0.8


def test_unknown_and_outside_are_occluded():
    left = np.array([[0.0, np.nan, 1.0, 1.0, -5.0]])
    right = np.array([[0.0, 1.0, np.nan, 0.0, 0.0]])
    assert occluded(left, right).tolist() == [[False, True, False, True, True]]


def test_the_right_view_is_matched_in_a_mirror():
    seen = []

    def match(left, right):
        seen.append((left, right))
        return np.arange(left.shape[1], dtype=np.float32)[None]

    left, right = np.array([[[1], [2], [3]]]), np.array([[[4], [5], [6]]])
    assert right_disparity(match, left, right).tolist() == [[2, 1, 0]]
    assert seen[0][0].ravel().tolist() == [6, 5, 4]
    assert seen[0][1].ravel().tolist() == [3, 2, 1]


def test_shapes():
    with pytest.raises(InputError, match="expected one shape"):
        right_disparity(lambda left, right: left, np.zeros((2, 2)), np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"\(1, 2\) and \(1, 3\)"):
        occluded(np.zeros((1, 2)), np.zeros((1, 3)))
    with pytest.raises(InputError, match="tau"):
        occluded(np.zeros((1, 2)), np.zeros((1, 2)), tau=-1)


@pytest.mark.parametrize("tau", [0.5, 2.0])
def test_tau_is_the_largest_difference(tau):
    right = np.full((1, 9), 3.0)
    left = right.copy()
    left[0, 6:] = 3 + tau, 3 + tau + 0.01, 3 - tau - 0.01
    assert occluded(left, right, tau=tau)[0, 6:].tolist() == [False, True, True]
