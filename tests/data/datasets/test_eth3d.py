import numpy as np
import pytest

from stereokit.data.datasets.eth3d import eth3d
from stereokit.errors import InputError
from tests.data.datasets import trees
from tests.shared import SHARED, needs_shared


def scene(folder, seed=0):
    trees.save_pair(folder / "im0.png", folder / "im1.png", seed)
    trees.save(folder / "calib.txt", trees.CALIB_TXT)


@pytest.mark.parametrize(
    ("images", "truth"),
    [
        ("two_view_training", "two_view_training_gt"),
        ("two_view_training", "two_view_training"),
        ("training", "training"),
        (".", "."),
    ],
)
def test_layouts(tmp_path, images, truth):
    for seed, name in enumerate(("delivery_area_1l", "terrains_2s")):
        scene(tmp_path / images / name, seed)
        trees.save(tmp_path / truth / name / "disp0GT.pfm", trees.DISPARITY)
        trees.save(tmp_path / truth / name / "mask0nocc.png", np.where(trees.KNOWN, 255, 128).astype(np.uint8))
    dataset = eth3d(tmp_path)
    assert [sample.name for sample in dataset] == ["delivery_area_1l", "terrains_2s"]
    trees.assert_pair(dataset[1], 1)
    trees.assert_truth(dataset[1])
    np.testing.assert_array_equal(dataset[1].nonocc, trees.KNOWN)
    assert dataset[1].calibration.baseline == pytest.approx(0.1)


def test_training_folder_of_truth_must_be_whole(tmp_path):
    scene(tmp_path / "two_view_training" / "a")
    scene(tmp_path / "two_view_training" / "b")
    trees.save(tmp_path / "two_view_training_gt" / "a" / "disp0GT.pfm", trees.DISPARITY)
    assert [path.parent.name for path in eth3d(tmp_path).missing_files()] == ["b"]


def test_test_part(tmp_path):
    scene(tmp_path / "two_view_test" / "lakeside_1l")
    (sample,) = eth3d(tmp_path, split="test")
    assert sample.disparity is None
    with pytest.raises(InputError, match=r"expected two_view_training/delivery_area_1l/im0\.png; found two_view_test/"):
        eth3d(tmp_path)


@needs_shared
def test_real_eth3d():
    (sample,) = eth3d(SHARED / "data" / "real" / "eth3d")
    assert 8 < np.nanmin(sample.disparity) < np.nanmax(sample.disparity) < 17.5
    assert 0.4 < np.isnan(sample.disparity).mean() < 0.6
    assert 2 < np.nanmin(sample.calibration.depth(sample.disparity)) < 6
