import shutil

import numpy as np
import pytest

from stereokit.data.datasets import check_dataset, format_report
from stereokit.data.datasets.middlebury import middlebury2014, middlebury_older, middlebury_v3
from stereokit.errors import InputError
from tests.data.datasets import trees
from tests.shared import SHARED, needs_shared


def scene(folder, truth="disp0.pfm", mask=False, seed=0):
    trees.save_pair(folder / "im0.png", folder / "im1.png", seed)
    trees.save(folder / "calib.txt", trees.CALIB_TXT)
    if truth:
        trees.save(folder / truth, trees.DISPARITY)
    if mask:
        trees.save(folder / "mask0nocc.png", np.where(trees.KNOWN, 255, 128).astype(np.uint8))


def older(folder, names, scale, suffix=".png", shape=trees.SHAPE):
    left, right, truth = names
    for name in (left, right):
        image = trees.picture(shape=shape)
        trees.save(folder / f"{name}{suffix}", image[..., 0] if suffix == ".pgm" else image)
    values = np.full(shape, 2 * scale, np.uint8)
    values[0, 0] = 0
    trees.save(folder / f"{truth}{'.pgm' if suffix == '.ppm' else suffix}", values)


@pytest.mark.parametrize("folder", [".", "MiddEval3"])
def test_v3(tmp_path, folder):
    for resolution in "HQ":
        scene(tmp_path / folder / f"training{resolution}" / "Adirondack", "disp0GT.pfm", mask=True)
        scene(tmp_path / folder / f"test{resolution}" / "Bicycle2", truth=None)
    (sample,) = middlebury_v3(tmp_path)
    assert sample.name == "Adirondack"
    trees.assert_pair(sample)
    trees.assert_truth(sample)
    np.testing.assert_array_equal(sample.nonocc, trees.KNOWN)
    assert sample.calibration.cx1 - sample.calibration.cx0 == pytest.approx(1)
    assert middlebury_v3(tmp_path, resolution="Q").entries[0].left.parent.parent.name == "trainingQ"
    (sample,) = middlebury_v3(tmp_path, split="test")
    assert sample.disparity is None
    with pytest.raises(InputError, match=r"expected trainingF/Adirondack/im0\.png"):
        middlebury_v3(tmp_path, resolution="F")
    with pytest.raises(InputError, match="unknown resolution 'full'; expected one of F, H, Q"):
        middlebury_v3(tmp_path, resolution="full")


def test_v3_without_its_truth_is_not_whole(tmp_path):
    scene(tmp_path / "trainingH" / "Adirondack", truth=None)
    assert [path.name for path in middlebury_v3(tmp_path).missing_files()] == ["disp0GT.pfm"]


def test_2014(tmp_path):
    scene(tmp_path / "Adirondack-perfect")
    scene(tmp_path / "Pipes-imperfect", seed=1)
    dataset = middlebury2014(tmp_path)
    assert [entry.name for entry in dataset.entries] == ["Adirondack-perfect", "Pipes-imperfect"]
    trees.assert_pair(dataset[1], 1)
    trees.assert_truth(dataset[1])
    assert dataset[1].nonocc is None
    assert len(middlebury2014(tmp_path / "Pipes-imperfect")) == 1
    (tmp_path / "Pipes-imperfect" / "im0.png").unlink()
    assert [path.name for path in middlebury2014(tmp_path).missing_files()] == ["im0.png"]


@pytest.mark.parametrize(
    ("name", "names", "suffix", "width", "scale"),
    [
        ("venus", ("im2", "im6", "disp2"), ".ppm", 434, 8),
        ("tsukuba", ("scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3"), ".ppm", 384, 16),
        ("map", ("im0", "im1", "disp0"), ".pgm", 284, 8),
        ("cones", ("im2", "im6", "disp2"), ".png", 450, 4),
        ("conesH", ("im2", "im6", "disp2"), ".ppm", 900, 2),
        ("teddyF", ("im2", "im6", "disp2"), ".ppm", 1800, 1),
        ("Aloe", ("view1", "view5", "disp1"), ".png", 427, 3),
        ("Art", ("view1", "view5", "disp1"), ".png", 695, 2),
        ("Baby1", ("view1", "view5", "disp1"), ".png", 1240, 1),
    ],
)
def test_older_scales(tmp_path, name, names, suffix, width, scale):
    older(tmp_path / "deep" / name, names, scale, suffix, (2, width))
    (sample,) = middlebury_older(tmp_path)
    assert sample.name == f"deep/{name}"
    assert np.isnan(sample.disparity[0, 0])
    assert np.nanmax(sample.disparity) == np.nanmin(sample.disparity) == 2


@pytest.mark.parametrize(
    ("name", "names", "right", "width", "scale"),
    [
        ("Art", ("view1", "view5", "disp1"), "disp5", 695, 2),
        ("cones", ("im2", "im6", "disp2"), "disp6", 450, 4),
        ("map", ("im0", "im1", "disp0"), "disp1", 284, 8),
    ],
)
def test_older_right_truth(tmp_path, name, names, right, width, scale):
    older(tmp_path / name, names, scale, shape=(2, width))
    assert middlebury_older(tmp_path)[0].right_disparity is None
    trees.save(tmp_path / name / f"{right}.png", np.full((2, width), 5 * scale, np.uint8))
    (sample,) = middlebury_older(tmp_path)
    assert (np.nanmax(sample.disparity), np.nanmax(sample.right_disparity)) == (2, 5)


@pytest.mark.parametrize(("dataset", "place"), [(middlebury2014, "Art"), (middlebury_v3, "trainingH/Art")])
def test_right_truth_of_newer_scenes(tmp_path, dataset, place):
    end = "GT" if dataset is middlebury_v3 else ""
    scene(tmp_path / place, f"disp0{end}.pfm")
    assert dataset(tmp_path)[0].right_disparity is None
    trees.save(tmp_path / place / f"disp1{end}.pfm", trees.DISPARITY + 1)
    trees.save(tmp_path / place / "mask1nocc.png", np.where(trees.KNOWN, 255, 128).astype(np.uint8))
    (sample,) = dataset(tmp_path)
    trees.assert_truth(sample)
    np.testing.assert_array_equal(sample.right_disparity, trees.DISPARITY + 1)
    np.testing.assert_array_equal(sample.right_nonocc, trees.KNOWN)


def test_older_masks_and_info(tmp_path):
    older(tmp_path / "mine", ("imL", "imR", "groundtruth"), 5)
    trees.save(tmp_path / "mine" / "nonocc.png", np.where(trees.KNOWN, 255, 0).astype(np.uint8))
    with pytest.raises(InputError, match="scene 'mine' is not one of the published ones; give scale="):
        middlebury_older(tmp_path)[0]
    assert np.nanmax(middlebury_older(tmp_path, scale="10")[0].disparity) == 1
    trees.save(tmp_path / "mine" / "info.txt", "5\n59\n")
    (sample,) = middlebury_older(tmp_path)
    assert np.nanmax(sample.disparity) == 2
    np.testing.assert_array_equal(sample.nonocc, trees.KNOWN)
    (tmp_path / "mine" / "info.txt").write_text("nonsense")
    with pytest.raises(InputError, match="expected the scale"):
        middlebury_older(tmp_path)[0]
    with pytest.raises(InputError, match="scale must be a number, got 'ten'"):
        middlebury_older(tmp_path, scale="ten")


def test_older_folders_that_make_no_pair_are_named(tmp_path):
    older(tmp_path / "venus", ("im2", "im6", "disp2"), 8)
    trees.save_pair(tmp_path / "mine" / "left.png", tmp_path / "mine" / "right.png", 0)
    (tmp_path / "notes").mkdir()
    dataset = middlebury_older(tmp_path)
    assert (len(dataset), dataset.passed_over) == (1, ("mine",))
    assert "passed over       mine" in format_report(check_dataset(dataset))
    assert "passed over" not in format_report(check_dataset(middlebury_older(tmp_path / "venus")))


def test_older_missing_view(tmp_path):
    older(tmp_path / "venus", ("im2", "im6", "disp2"), 8)
    (tmp_path / "venus" / "im6.png").unlink()
    assert [path.name for path in middlebury_older(tmp_path).missing_files()] == ["im6.png"]


def test_other_trees(tmp_path):
    with pytest.raises(InputError, match="found an empty folder"):
        middlebury2014(tmp_path)
    with pytest.raises(InputError, match=r"a folder with view1\.png"):
        middlebury_older(tmp_path)


@needs_shared
def test_real_scenes(tmp_path):
    real = SHARED / "data" / "real" / "middlebury"
    highest = {"Cloth3": 83, "teddy": 53, "tsukuba": 14, "venus": 20}
    dataset = middlebury_older(real)
    assert [entry.name for entry in dataset.entries] == list(highest)
    for sample in dataset:
        assert np.nanmax(sample.disparity) == pytest.approx(highest[sample.name], abs=0.5)
        assert (sample.nonocc is None) == (sample.name == "Cloth3")
        assert (sample.right_disparity is None) == (sample.name != "Cloth3")
    assert np.nanmax(dataset[0].right_disparity) == pytest.approx(83, abs=1)
    shutil.copytree(SHARED / "data" / "real" / "eth3d" / "terrace", tmp_path / "scene")
    assert len(middlebury2014(tmp_path)) == 1
