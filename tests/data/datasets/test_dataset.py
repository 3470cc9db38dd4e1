import pickle

import numpy as np
import pytest
from torch.utils.data import DataLoader

from stereokit.calibration import Calibration
from stereokit.data.datasets import StereoSample
from stereokit.data.datasets.kitti import kitti2012
from stereokit.errors import InputError
from tests.data.datasets import trees


def first(batch):
    return batch[0]


def test_it_is_a_sequence(tmp_path):
    trees.kitti2012(tmp_path, range(4))
    dataset = kitti2012(tmp_path)
    assert len(dataset) == 4
    assert [sample.name for sample in dataset] == [dataset[index].name for index in range(4)]
    trees.assert_pair(dataset[-1], 3)
    assert [sample.name for sample in dataset[1:3]] == ["000001_10", "000002_10"]
    assert len(dataset[:99]) == 4
    assert "4 pairs" in repr(dataset)
    with pytest.raises(IndexError):
        dataset[4]


def test_nothing_is_read_before_it_is_asked_for(tmp_path):
    trees.kitti2012(tmp_path, range(2))
    (tmp_path / "training" / "image_1" / "000001_10.png").write_bytes(b"broken")
    dataset = kitti2012(tmp_path)
    trees.assert_pair(dataset[0])
    with pytest.raises(InputError, match="000001_10"):
        dataset[1]


def test_it_goes_to_the_workers_of_a_loader(tmp_path):
    trees.kitti2012(tmp_path, range(3))
    dataset = pickle.loads(pickle.dumps(kitti2012(tmp_path)))
    samples = list(DataLoader(dataset, collate_fn=first, num_workers=1, multiprocessing_context="fork"))
    for number, sample in enumerate(samples):
        trees.assert_pair(sample, number)


@pytest.mark.parametrize("part", ["right", "disparity", "nonocc", "objects", "right_disparity", "right_nonocc"])
def test_the_parts_are_of_one_size(part):
    parts = {
        "right": np.zeros((2, 4, 3), np.uint8),
        "disparity": np.zeros((2, 4), np.float32),
        "nonocc": np.zeros((2, 4), bool),
        "objects": np.zeros((2, 4), np.uint8),
        "right_disparity": np.zeros((2, 4), np.float32),
        "right_nonocc": np.zeros((2, 4), bool),
    }
    left = np.zeros((2, 4, 3), np.uint8)
    StereoSample("a", left, **parts)
    parts[part] = parts[part][:, :3]
    with pytest.raises(InputError, match=r"pair 'a': the .* is 3 x 2 pixels, the left image 4 x 2"):
        StereoSample("a", left, **parts)


def test_the_calibration_is_of_the_size_of_the_images():
    left = np.zeros((2, 4, 3), np.uint8)
    for size in ((4, 2), (None, None)):
        camera = Calibration(700, 0.1, 2, 2, *size)
        assert StereoSample("a", left, left, calibration=camera).calibration == camera
    with pytest.raises(InputError, match=r"the calibration is of images of 8 x 4 pixels, the left image is 4 x 2"):
        StereoSample("a", left, left, calibration=Calibration(700, 0.1, 2, 2, 8, 4))


def test_maps_have_one_channel_and_images_three():
    left = np.zeros((2, 4, 3), np.uint8)
    with pytest.raises(InputError, match=r"the ground truth has shape \(2, 4, 3\); expected \(H, W\)"):
        StereoSample("a", left, left, np.zeros((2, 4, 3), np.float32))
    for wrong in (left[..., 0], left[..., :2], left[:0]):
        with pytest.raises(InputError, match=r"expected \(H, W, 3\)"):
            StereoSample("a", wrong, left)
        with pytest.raises(InputError, match=r"expected \(H, W, 3\)"):
            StereoSample("a", left, wrong)
