import numpy as np
import pytest

from stereokit.data import open_dataset, read_image, write_image
from stereokit.data.datasets.kitti import is_validation_frame, kitti2012, kitti2015, kitti_raw
from stereokit.errors import InputError
from tests.data.datasets import trees
from tests.shared import SHARED, needs_shared


def test_kitti2012(tmp_path):
    trees.kitti2012(tmp_path)
    dataset = kitti2012(tmp_path)
    assert [entry.name for entry in dataset.entries] == ["000000_10", "000001_10"]
    for number, sample in enumerate(dataset):
        trees.assert_pair(sample, number)
        trees.assert_truth(sample)
        np.testing.assert_array_equal(sample.nonocc, trees.KNOWN & (np.arange(9) >= 5))
        assert sample.objects is None
        assert sample.calibration.baseline == pytest.approx(0.5)


def test_kitti2012_views(tmp_path):
    trees.kitti2012(tmp_path, [3])
    assert kitti2012(tmp_path).entries[0].left.parent.name == "image_0"
    with pytest.raises(InputError, match="no pairs of kitti2012"):
        kitti2012(tmp_path, views="colour")
    for number, view in enumerate(("colored_0", "colored_1")):
        trees.save(tmp_path / "training" / view / "000003_10.png", trees.picture(number))
    assert kitti2012(tmp_path).entries[0].left.parent.name == "colored_0"
    assert kitti2012(tmp_path)[0].calibration.baseline == pytest.approx(0.6)
    assert kitti2012(tmp_path, views="grey").entries[0].left.parent.name == "image_0"


def test_test_part_has_no_truth(tmp_path):
    trees.kitti2012(tmp_path, part="testing")
    sample = kitti2012(tmp_path, split="testing")[1]
    trees.assert_pair(sample, 1)
    assert sample.disparity is None
    assert sample.nonocc is None


def test_inside_the_archive(tmp_path):
    trees.kitti2012(tmp_path / "data_stereo_flow")
    trees.kitti2015(tmp_path / "data_scene_flow")
    assert len(kitti2012(tmp_path)) == len(kitti2015(tmp_path)) == 2


def test_kitti2015(tmp_path):
    trees.kitti2015(tmp_path)
    sample = kitti2015(tmp_path)[1]
    trees.assert_pair(sample, 1)
    trees.assert_truth(sample)
    np.testing.assert_array_equal(sample.nonocc, trees.KNOWN)
    np.testing.assert_array_equal(sample.objects, np.arange(54).reshape(6, 9))
    assert sample.objects.dtype == np.uint8
    assert (sample.calibration.width, sample.calibration.height) == (9, 6)


def test_the_object_map_is_one_byte(tmp_path):
    trees.kitti2015(tmp_path, [0])
    (tmp_path / "training" / "obj_map" / "000000_10.png").unlink()
    trees.save(tmp_path / "training" / "obj_map" / "000000_10.png", trees.stored(1))
    with pytest.raises(InputError, match="expected an object map, an 8-bit grey PNG"):
        kitti2015(tmp_path)[0]


def test_the_split_is_nine_to_one_and_fixed(tmp_path):
    trees.kitti2015(tmp_path, range(25))
    names = {split: {entry.name for entry in kitti2015(tmp_path, split=split).entries} for split in ("train", "val")}
    assert names["val"] == {"000000_10", "000010_10", "000020_10"}
    assert len(names["train"]) == 22
    assert not names["train"] & names["val"]
    # It hangs on the number alone, so a missing frame moves no other.
    for kind in ("image_2", "image_3"):
        (tmp_path / "training" / kind / "000003_10.png").unlink()
    assert {entry.name for entry in kitti2015(tmp_path, split="val").entries} == names["val"]


@pytest.mark.parametrize("count", [194, 200])
def test_the_validation_part_is_a_tenth(count):
    assert sum(map(is_validation_frame, range(count))) == 20


def test_kitti_raw(tmp_path):
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for number in range(2):
        for left, right in (("02", "03"), ("00", "01")):
            left, right = (drive / f"image_{view}" / "data" / f"{number:010d}.png" for view in (left, right))
            trees.save_pair(left, right, number)
    rows = "".join(f"P_rect_0{camera}: {row}\n" for camera, row in trees.KITTI_ROWS.items())
    trees.save(tmp_path / "2011_09_26" / "calib_cam_to_cam.txt", rows)
    dataset = kitti_raw(tmp_path)
    assert [entry.name for entry in dataset.entries] == [f"{drive.name}/000000000{number}" for number in range(2)]
    trees.assert_pair(dataset[1], 1)
    assert dataset[0].disparity is None
    assert dataset[0].calibration.baseline == pytest.approx(0.6)
    assert kitti_raw(tmp_path, views="grey")[0].calibration.baseline == pytest.approx(0.5)


def test_other_trees_and_splits(tmp_path):
    (tmp_path / "Photos").mkdir()
    with pytest.raises(InputError, match=r"no pairs of kitti2012, split 'train', in .*: expected "
                       r"training/image_0/\*_10\.png; found Photos/"):  # fmt: skip
        kitti2012(tmp_path, split="train")
    with pytest.raises(InputError, match="found nothing, it does not exist"):
        kitti2015(tmp_path / "absent")
    with pytest.raises(InputError, match="unknown split 'test'; expected one of training, train, val, testing"):
        kitti2015(tmp_path, split="test")
    with pytest.raises(InputError, match="unknown views 'infrared'"):
        kitti2012(tmp_path, views="infrared")
    with pytest.raises(InputError, match="found Photos/"):
        kitti_raw(tmp_path)


@pytest.mark.parametrize(("kind", "tree"), [(kitti2012, trees.kitti2012), (kitti2015, trees.kitti2015)])
def test_an_empty_split_names_those_with_pairs(tmp_path, kind, tree):
    tree(tmp_path / "a", [3, 4])
    with pytest.raises(InputError, match=r"split 'val' of kitti201\d is empty in .*of split 'training' or 'train'$"):
        kind(tmp_path / "a", split="val")
    tree(tmp_path / "b", [10])
    with pytest.raises(InputError, match=r"split 'train' of .* of split 'training' or 'val'$"):
        kind(tmp_path / "b", split="train")


@needs_shared
def test_real_kitti2012():
    dataset = kitti2012(SHARED / "data" / "real" / "kitti2012")
    assert [entry.name for entry in dataset.entries] == ["000027_10", "000138_10"]
    for sample in dataset:
        assert 4 < np.nanmin(sample.disparity) < np.nanmax(sample.disparity) < 119
        assert 0.2 < np.isfinite(sample.disparity).mean() < 0.4
        assert np.isfinite(sample.disparity)[sample.nonocc].all()
        assert sample.calibration.baseline == pytest.approx(0.537, abs=0.001)
    assert len(kitti2012(SHARED / "data" / "real" / "kitti2012", split="train")) == 2


@pytest.mark.parametrize("kind", ["kitti2012", "kitti2015"])
def test_images_may_be_jpeg_and_frames_11_have_no_truth(tmp_path, kind):
    getattr(trees, kind)(tmp_path)
    folders = ("image_0", "image_1") if kind == "kitti2012" else ("image_2", "image_3")
    for view in folders:
        if kind == "kitti2015":
            trees.save(tmp_path / "training" / view / "000000_11.png", trees.picture())
        image = read_image(tmp_path / "training" / view / "000000_10.png")
        (tmp_path / "training" / view / "000000_10.png").unlink()
        write_image(tmp_path / "training" / view / "000000_10.jpg", image)
        (tmp_path / "training" / view / "._000000_10.jpg").write_bytes(b"\0\5\x16\7")
    dataset = open_dataset(f"{kind}:{tmp_path}")
    assert [entry.name for entry in dataset.entries] == ["000000_10", "000001_10"]
    assert [entry.left.suffix for entry in dataset.entries] == [".jpg", ".png"]
    trees.assert_truth(dataset[0])
