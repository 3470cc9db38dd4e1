import sys
from types import SimpleNamespace

import numpy as np
import pytest

from stereokit.data.datasets import open_dataset
from stereokit.data.datasets.spring import read_spring_disparity
from stereokit.errors import InputError
from tests.data.datasets import trees


def jpeg(path, seed=0):
    trees.save(path, trees.picture(seed))


def test_instereo2k(tmp_path):
    for place in ("train/part1/000000", "train/part2/000001", "test/000040"):
        trees.save_pair(tmp_path / place / "left.png", tmp_path / place / "right.png")
        trees.save(tmp_path / place / "left_disp.png", trees.stored(100))
        trees.save(tmp_path / place / "right_disp.png", trees.stored(100))
    (sample,) = open_dataset(f"instereo2k:{tmp_path}")
    assert sample.name == "test/000040"
    trees.assert_pair(sample)
    trees.assert_truth(sample)
    np.testing.assert_array_equal(sample.right_disparity, trees.DISPARITY)
    assert sample.assumed_scale is None
    names = [entry.name for entry in open_dataset(f"instereo2k/train:{tmp_path}").entries]
    assert names == ["train/part1/000000", "train/part2/000001"]
    assert len(open_dataset(f"instereo2k/all:{tmp_path}")) == 3
    assert [entry.name for entry in open_dataset(f"instereo2k/all:{tmp_path / 'test/000040'}").entries] == ["000040"]
    with pytest.raises(InputError, match="it can be opened as folder"):
        open_dataset(f"spring:{tmp_path / 'train' / 'part1'}")


def test_booster(tmp_path):
    scene = tmp_path / "train" / "balanced" / "Bathroom"
    for number in range(2):
        trees.save_pair(scene / "camera_00" / f"im{number}.png", scene / "camera_02" / f"im{number}.png", number)
    np.save(scene / "disp_00.npy", trees.DISPARITY)
    trees.save(scene / "mask_00.png", np.where(trees.KNOWN, 255, 0).astype(np.uint8))
    test = tmp_path / "test" / "balanced" / "Car"
    trees.save_pair(test / "camera_00" / "im0.png", test / "camera_02" / "im0.png")
    dataset = open_dataset(f"booster:{tmp_path}")
    assert [entry.name for entry in dataset.entries] == ["Bathroom/im0", "Bathroom/im1"]
    trees.assert_pair(dataset[1], 1)
    trees.assert_truth(dataset[1])
    np.testing.assert_array_equal(dataset[0].nonocc, trees.KNOWN)
    assert open_dataset(f"booster/test:{tmp_path}")[0].disparity is None
    (scene / "disp_00.npy").unlink()
    with pytest.raises(InputError, match="is not whole: 2 of its files are missing"):
        open_dataset(f"booster:{tmp_path}")


def test_crestereo(tmp_path):
    for part, name in (("tree", "tree/0/a_b"), ("hole", "hole/c")):
        for side in ("left", "right"):
            jpeg(tmp_path / f"{name}_{side}.jpg")
            trees.save(tmp_path / f"{name}_{side}.disp.png", trees.stored(32))
        trees.assert_truth(open_dataset(f"crestereo,part={part}:{tmp_path}")[0])
    dataset = open_dataset(f"crestereo:{tmp_path}")
    assert [entry.name for entry in dataset.entries] == ["hole/c", "tree/0/a_b"]
    np.testing.assert_array_equal(dataset[1].right_disparity, trees.DISPARITY)
    (tmp_path / "hole/c_right.jpg").unlink()
    with pytest.raises(InputError, match=r"the first is 'hole/c_right\.jpg'"):
        open_dataset(f"crestereo:{tmp_path}")


def test_tartanair(tmp_path):
    shape = (480, 640)
    for level in ("Easy", "Hard"):
        flight = tmp_path / "office" / level / "P000"
        for side in ("left", "right"):
            trees.save(flight / f"image_{side}" / f"000003_{side}.png", trees.picture(shape=shape))
        (flight / "depth_left").mkdir()
        np.save(flight / "depth_left" / "000003_left_depth.npy", np.full(shape, 20.0, np.float32))
    (sample,) = open_dataset(f"tartanair,difficulty=Hard:{tmp_path}")
    assert sample.name == "office/Hard/P000/000003"
    assert (sample.disparity == 4).all()
    assert sample.calibration.depth(4.0) == 20
    assert len(open_dataset(f"tartanair:{tmp_path}")) == 2


@pytest.mark.parametrize("archives", [False, True])
def test_virtual_kitti2(tmp_path, archives):
    shape, place = (375, 1242), "Scene01/clone/frames"
    images = tmp_path / ("vkitti_2.0.3_rgb" if archives else ".")
    depths = tmp_path / ("vkitti_2.0.3_depth" if archives else ".")
    depth = np.full(shape, 725.0087 * 53.2725 / 4, np.uint16)
    depth[0, :2] = 65535, 0
    for camera in (0, 1):
        trees.save(images / place / f"rgb/Camera_{camera}/rgb_00007.jpg", trees.picture(shape=shape))
        trees.save(depths / place / f"depth/Camera_{camera}/depth_00007.png", depth)
    (sample,) = open_dataset(f"virtual_kitti2,variation=clone:{tmp_path}")
    assert sample.name == "Scene01/clone/rgb_00007"
    assert np.isnan(sample.disparity[0, :2]).all()
    np.testing.assert_allclose(sample.disparity[1:], 4, rtol=1e-3)
    assert sample.calibration.depth(4.0) == pytest.approx(725.0087 * 0.532725 / 4)
    np.testing.assert_array_equal(sample.right_disparity, sample.disparity)
    with pytest.raises(InputError, match="expected Scene01/fog/frames"):
        open_dataset(f"virtual_kitti2,variation=fog:{tmp_path}")


def film(tmp_path):
    scene = tmp_path / "spring" / "train" / "0001"
    trees.save_pair(scene / "frame_left/frame_left_0002.png", scene / "frame_right/frame_right_0002.png")
    (scene / "disp1_left").mkdir()
    (scene / "disp1_left" / "disp1_left_0002.dsp5").write_bytes(b"stands for HDF5")
    return open_dataset(f"spring:{tmp_path}")


def test_spring_without_h5py(tmp_path, monkeypatch):
    dataset = film(tmp_path)
    assert [entry.name for entry in dataset.entries] == ["0001/0002"]
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"HDF5, which the package h5py reads; pip install 'stereokit\[spring\]'"):
        dataset[0]


class File(dict):
    def __init__(self, path, mode):
        assert mode == "r"
        doubled = np.repeat(np.repeat(trees.DISPARITY, 2, axis=0), 2, axis=1)
        doubled[1::2] = doubled[:, 1::2] = 99
        super().__init__(disparity=doubled)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def test_spring_takes_every_other_row_and_column(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", SimpleNamespace(File=File))
    (sample,) = film(tmp_path)
    trees.assert_pair(sample)
    trees.assert_truth(sample)


def test_spring_with_h5py(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.dsp5", "w") as file:
        file["disparity"] = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert read_spring_disparity(tmp_path / "a.dsp5").tolist() == [[0, 2, 4], [12, 14, 16]]
    with h5py.File(tmp_path / "b.dsp5", "w") as file:
        file["flow"] = np.zeros((2, 2))
    (tmp_path / "c.dsp5").write_bytes(b"no HDF5")
    for name in ("b.dsp5", "c.dsp5"):
        with pytest.raises(InputError, match="no HDF5 file with a data set 'disparity', or a broken one"):
            read_spring_disparity(tmp_path / name)


@pytest.mark.parametrize("folder", [".", "data"])
def test_middlebury2021(tmp_path, folder):
    scene = tmp_path / folder / "artroom1"
    trees.save_pair(scene / "im0.png", scene / "im1.png")
    trees.save_pair(scene / "im0e1.png", scene / "im1e1.png", 1)
    trees.save(scene / "disp0.pfm", trees.DISPARITY)
    trees.save(scene / "disp1.pfm", trees.DISPARITY)
    trees.save(scene / "calib.txt", trees.CALIB_TXT)
    (sample,) = open_dataset(f"middlebury2021:{tmp_path}")
    assert sample.name == "artroom1"
    trees.assert_pair(sample)
    trees.assert_truth(sample)
    np.testing.assert_array_equal(sample.right_disparity, trees.DISPARITY)
    assert sample.calibration.baseline == pytest.approx(0.1)
