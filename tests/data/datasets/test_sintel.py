import numpy as np
import pytest

from stereokit.data.datasets.sintel import sintel
from stereokit.errors import InputError
from tests.data.datasets import trees


@pytest.fixture
def tree(tmp_path):
    training = tmp_path / "training"
    for seed, image_pass in enumerate(("clean", "final")):
        for frame in ("frame_0001", "frame_0002"):
            left, right = (training / f"{image_pass}_{view}" / "alley_1" / f"{frame}.png" for view in ("left", "right"))
            trees.save_pair(left, right, seed)
    values = np.linspace(0.25, 600, 54).reshape(6, 9)
    channels = [values // 4, values * 64 % 256, values * 2**14 % 256]
    for frame in ("frame_0001", "frame_0002"):
        trees.save(training / "disparities" / "alley_1" / f"{frame}.png", np.stack(channels, -1).astype(np.uint8))
        for part, column in (("occlusions", 2), ("outofframe", 0)):
            mask = np.zeros((6, 9), np.uint8)
            mask[:, column] = 1 if part == "occlusions" else 255
            trees.save(training / part / "alley_1" / f"{frame}.png", mask)
    return tmp_path


def test_sintel(tree):
    for root in (tree, tree / "training"):
        for seed, image_pass in enumerate(("clean", "final")):
            dataset = sintel(root, image_pass=image_pass)
            assert [entry.name for entry in dataset.entries] == ["alley_1/frame_0001", "alley_1/frame_0002"]
            trees.assert_pair(dataset[0], seed)
    np.testing.assert_allclose(dataset[0].disparity, np.linspace(0.25, 600, 54).reshape(6, 9), atol=2**-13)
    assert dataset[0].nonocc.tolist() == [[column not in (0, 2) for column in range(9)]] * 6


def test_masks_of_two_sizes(tree):
    path = tree / "training" / "outofframe" / "alley_1" / "frame_0001.png"
    path.unlink()
    trees.save(path, np.zeros((2, 2), np.uint8))
    with pytest.raises(InputError, match="of different sizes"):
        sintel(tree)[0]


def test_a_missing_right_view_is_noticed(tree):
    gone = tree / "training" / "final_right" / "alley_1" / "frame_0002.png"
    gone.unlink()
    assert sintel(tree).missing_files() == [gone]


def test_a_missing_left_view_is_noticed(tree):
    gone = tree / "training" / "final_left" / "alley_1" / "frame_0002.png"
    gone.unlink()
    assert sintel(tree).missing_files() == [gone]


def test_other_trees(tmp_path):
    with pytest.raises(InputError, match=r"expected training/final_left/alley_1/\*\.png"):
        sintel(tmp_path)
    with pytest.raises(InputError, match="unknown split 'test'; expected one of training"):
        sintel(tmp_path, split="test")
