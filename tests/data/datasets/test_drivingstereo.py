import pytest

from stereokit.data.datasets.drivingstereo import drivingstereo
from stereokit.errors import InputError
from tests.data.datasets import trees

SEQUENCE = "2018-07-11-14-48-52"
NAME = f"{SEQUENCE}_2018-07-11-14-50-08-769"
PARTS = ("left-image", "right-image", "disparity-map")


def write(left, right, truth, scale):
    trees.save_pair(left, right)
    trees.save(truth, trees.stored(scale))


def test_half_size_as_distributed(tmp_path):
    left, right, truth = (tmp_path / f"test-{part}" / SEQUENCE / NAME for part in PARTS)
    write(left.with_suffix(".png"), right.with_suffix(".png"), truth.with_suffix(".png"), 256)
    rows = "".join(f"P_rect_{camera}: {trees.KITTI_ROWS[(camera - 101) // 2]}\n" for camera in (101, 103))
    rows += "T_103: -0.3 0.0 0.4\n"
    trees.save(tmp_path / "calib" / "half-image-calib" / f"{SEQUENCE}.txt", rows)
    (sample,) = drivingstereo(tmp_path)
    assert sample.name == f"{SEQUENCE}/{NAME}"
    trees.assert_pair(sample)
    trees.assert_truth(sample)
    assert sample.calibration.baseline == pytest.approx(0.5)
    with pytest.raises(InputError, match="expected test-left-image/left-image-full-size/; found calib/, test-"):
        drivingstereo(tmp_path, size="full")


@pytest.mark.parametrize(("size", "scale"), [("half", 256), ("full", 128)])
def test_sized_folders(tmp_path, size, scale):
    for part in ("test", "train"):
        files = (tmp_path / f"{part}-{p}" / f"{p}-{size}-size" / SEQUENCE / f"{NAME}.png" for p in PARTS)
        write(*files, scale)
    for split in ("test", "train"):
        (sample,) = drivingstereo(tmp_path, split=split, size=size)
        trees.assert_truth(sample)


@pytest.mark.parametrize(("size", "scale"), [("half", 256), ("full", 128)])
def test_weather(tmp_path, size, scale):
    write(*(tmp_path / "foggy" / f"{part}-{size}-size" / f"{NAME}.png" for part in PARTS), scale)
    (sample,) = drivingstereo(tmp_path, split="foggy", size=size)
    assert sample.name == NAME
    trees.assert_truth(sample)
    assert sample.calibration is None


def test_jpegs_have_truth_in_png(tmp_path):
    left, right, truth = (tmp_path / f"train-{part}" / SEQUENCE / NAME for part in PARTS)
    write(left.with_suffix(".jpg"), right.with_suffix(".jpg"), truth.with_suffix(".png"), 256)
    (sample,) = drivingstereo(tmp_path, split="train")
    trees.assert_truth(sample)


def test_unknown(tmp_path):
    with pytest.raises(InputError, match="unknown split 'snowy'; expected one of train, test, sunny"):
        drivingstereo(tmp_path, split="snowy")
    with pytest.raises(InputError, match="unknown size"):
        drivingstereo(tmp_path, size="third")
