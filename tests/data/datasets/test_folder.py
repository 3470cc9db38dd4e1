import contextlib
import warnings

import numpy as np
import pytest

from stereokit.data import write_disparity
from stereokit.data.datasets import check_dataset, format_report
from stereokit.data.datasets.folder import folder
from stereokit.errors import InputError
from tests.data.datasets import trees
from tests.shared import SHARED, needs_shared


def test_parallel_folders(tmp_path):
    for seed, name in enumerate(("a", "b")):
        trees.save_pair(tmp_path / "left" / f"{name}.png", tmp_path / "right" / f"{name}.png", seed)
        trees.save(tmp_path / "disparity" / f"{name}.pfm", trees.DISPARITY)
    trees.save(tmp_path / "nonocc" / "b.png", np.where(trees.KNOWN, 255, 0).astype(np.uint8))
    trees.save(tmp_path / "calib.txt", trees.CALIB_TXT)
    dataset = folder(tmp_path)
    assert [sample.name for sample in dataset] == ["a", "b"]
    trees.assert_pair(dataset[1], 1)
    trees.assert_truth(dataset[1])
    np.testing.assert_array_equal(dataset[1].nonocc, trees.KNOWN)
    assert dataset[0].nonocc is None
    assert dataset[0].calibration.baseline == pytest.approx(0.1)
    for gone in ("left/a.png", "right/b.png", "disparity/b.pfm"):
        (tmp_path / gone).unlink()
    missing = {path.relative_to(tmp_path).as_posix() for path in folder(tmp_path).missing_files()}
    assert missing == {"left/a.png", "right/b.png", "disparity/b.pfm"}


def test_pairs_without_truth(tmp_path):
    trees.save_pair(tmp_path / "left" / "a.png", tmp_path / "right" / "a.jpg")
    (sample,) = folder(tmp_path)
    assert sample.disparity is sample.nonocc is sample.calibration is None


@pytest.mark.parametrize("suffix", [".pfm", ".npy", ".npz", ".png"])
def test_folder_of_scenes(tmp_path, suffix):
    for seed, name in enumerate(("kitchen", "garden")):
        trees.save_pair(tmp_path / name / "left.ppm", tmp_path / name / "right.ppm", seed)
    write_disparity(tmp_path / "kitchen" / f"disparity{suffix}", trees.DISPARITY)
    warned = pytest.warns(UserWarning, match="taken to hold 256") if suffix == ".png" else contextlib.nullcontext()
    trees.save(tmp_path / "garden" / "calib.txt", trees.CALIB_TXT)
    dataset = folder(tmp_path)
    assert [entry.name for entry in dataset.entries] == ["garden", "kitchen"]
    trees.assert_pair(dataset[0], 1)
    with warned:
        trees.assert_truth(dataset[1])
    assert dataset[0].calibration is not None
    assert [entry.name for entry in folder(tmp_path / "kitchen").entries] == ["kitchen"]
    (tmp_path / "garden" / "right.ppm").unlink()
    assert [path.name for path in folder(tmp_path).missing_files()] == ["right.png"]


def test_scale_and_encoding_for_all(tmp_path):
    trees.save_pair(tmp_path / "left.png", tmp_path / "right.png")
    trees.save(tmp_path / "disparity.png", trees.stored(8, np.uint8))
    with pytest.raises(InputError, match="give scale="):
        folder(tmp_path)[0]
    trees.assert_truth(folder(tmp_path, scale="8")[0])
    with pytest.raises(InputError, match="scale must be a number"):
        folder(tmp_path, scale="eight")
    with pytest.raises(InputError, match="unknown disparity encoding 'kity'"):
        folder(tmp_path, encoding="kity")[0]


LIST = """
# two pairs
"my pictures/l.png" 'my pictures/r.png' truth.png scale=8 nonocc=mask.png name=first
my\\ pictures/l.png "my pictures/r.png"   # without truth

other/l.png other/r.png truth.pfm calibration=calib.txt
other/l.png other/r.png sintel.png encoding=sintel name=encoded
"""


def test_list_file(tmp_path):
    for seed, place in enumerate(("my pictures", "other")):
        trees.save_pair(tmp_path / place / "l.png", tmp_path / place / "r.png", seed)
    trees.save(tmp_path / "truth.png", trees.stored(8, np.uint8))
    trees.save(tmp_path / "truth.pfm", trees.DISPARITY)
    trees.save(tmp_path / "sintel.png", np.full((*trees.SHAPE, 3), [1, 64, 0], np.uint8))
    trees.save(tmp_path / "mask.png", np.where(trees.KNOWN, 255, 0).astype(np.uint8))
    trees.save(tmp_path / "calib.txt", trees.CALIB_TXT)
    trees.save(tmp_path / "pairs.txt", LIST)
    dataset = folder(tmp_path / "pairs.txt")
    assert [entry.name for entry in dataset.entries] == ["first", "my pictures/l", "other/l", "encoded"]
    trees.assert_truth(dataset[0])
    np.testing.assert_array_equal(dataset[0].nonocc, trees.KNOWN)
    assert dataset[1].disparity is None
    trees.assert_pair(dataset[2], 1)
    trees.assert_truth(dataset[2])
    assert dataset[2].calibration is not None
    assert (dataset[3].disparity == 5).all()


NAMES = ["a/left.png", "a/right.png", "a/d.pfm"]


@pytest.mark.parametrize(
    ("line", "names"),
    [
        (" ".join(NAMES), NAMES),
        (",".join(NAMES), NAMES),
        (", ".join(NAMES), NAMES),
        ("\t".join(NAMES), NAMES),
        (" ".join(NAMES).replace("/", "\\"), NAMES),
        ("my\\ data/left.png 'my data/right.png' \"my data/d.pfm\"", [f"my data/{name[2:]}" for name in NAMES]),
        ("my data/left.png,my data/right.png,my data/d.pfm", [f"my data/{name[2:]}" for name in NAMES]),
        ("seq#3/left.png seq#3/right.png seq#3/d.pfm # third", [f"seq#3/{name[2:]}" for name in NAMES]),
        ('\\#4/left.png "#4/right.png" \\#4/d.pfm', [f"#4/{name[2:]}" for name in NAMES]),
        ("it's/left.png it's/right.png it's/d.pfm", [f"it's/{name[2:]}" for name in NAMES]),
        ("x=1/left.png x=1/right.png x=1/d.pfm name='the pair'", [f"x=1/{name[2:]}" for name in NAMES]),
        ("1,2/left.png 1,2/right.png 1,2/d.pfm", [f"1,2/{name[2:]}" for name in NAMES]),
    ],
)
def test_names_in_a_list(tmp_path, line, names):
    trees.save_pair(tmp_path / names[0], tmp_path / names[1])
    trees.save(tmp_path / names[2], trees.DISPARITY)
    trees.save(tmp_path / "pairs.txt", f"# comment\n{line}\n")
    (sample,) = folder(tmp_path / "pairs.txt")
    trees.assert_pair(sample)
    trees.assert_truth(sample)
    assert sample.name == ("the pair" if "the pair" in line else names[0][:-4])


def test_hidden_files_are_not_looked_at(tmp_path):
    trees.save_pair(tmp_path / "left" / "a.png", tmp_path / "right" / "a.png")
    for name in ("left/._a.png", "right/._b.png", "left/.DS_Store"):
        (tmp_path / name).write_bytes(b"\0\5\x16\7")
    assert [sample.name for sample in folder(tmp_path)] == ["a"]


@pytest.mark.parametrize("scenes", [True, False])
def test_truth_of_another_name_is_not_passed_over_in_silence(tmp_path, scenes):
    for name in ("000000", "000001"):
        left, right = (f"{name}/left.png", f"{name}/right.png") if scenes else (f"left/{name}.png", f"right/{name}.png")
        trees.save_pair(tmp_path / left, tmp_path / right)
        trees.save(tmp_path / (f"{name}/left_disp.png" if scenes else f"disp_gt/{name}.png"), trees.stored(100))
    with pytest.warns(UserWarning, match="what looks like ground truth is not read: '(000000/left_disp.png|disp_gt)'"):
        dataset = folder(tmp_path)
    assert dataset.unused_truth == (("000000/left_disp.png", "000001/left_disp.png") if scenes else ("disp_gt",))
    assert "looks like ground truth, but is not named" in format_report(check_dataset(dataset))


def test_the_assumed_scale_is_named(tmp_path):
    trees.save_pair(tmp_path / "a/left.png", tmp_path / "a/right.png")
    trees.save(tmp_path / "a/disparity.png", trees.stored(100))
    with pytest.warns(UserWarning, match=r"taken to hold 256 for a pixel .* say so \(scale=256\)"):
        sample = folder(tmp_path)[0]
    assert sample.assumed_scale == 256
    trees.save(tmp_path / "pairs.txt", "a/left.png a/right.png a/disparity.png\na/left.png a/right.png name=b")
    report = check_dataset(folder(tmp_path / "pairs.txt"))
    assert report.assumed_scales == {256: 1}
    assert "scale assumed     256 for a pixel of disparity, in 1 pair" in format_report(report)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sample = folder(tmp_path, scale=100)[0]
        assert folder(tmp_path, encoding="kitti")[0].assumed_scale is None
    trees.assert_truth(sample)
    assert sample.assumed_scale is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("l.png", "line 2: expected a left image, a right image and perhaps disparity, got 1 files"),
        ("l.png r.png d.pfm e.pfm", "got 4 files"),
        ("l.png r.png scal=8", "line 2: unknown 'scal'; did you mean 'scale'"),
        ("l.png r.png d.png scale=x", "line 2: scale must be a number, got 'x'"),
        ("l.png 'r.png", "line 2: the quotation mark ' is not closed"),
        ("l.png r.png\nl.png r.png", "2 pairs of folder in .* have the name 'l'"),
        ("", "no pairs of folder"),
    ],
)
def test_lines_that_can_not_be_understood(tmp_path, line, message):
    trees.save(tmp_path / "pairs.txt", f"# comment\n{line}\n")
    with pytest.raises(InputError, match=message):
        folder(tmp_path / "pairs.txt")


def test_a_picture_is_no_list(tmp_path):
    trees.save(tmp_path / "a.png", trees.picture())
    with pytest.raises(InputError, match="no list of pairs: it is not UTF-8"):
        folder(tmp_path / "a.png")


def test_other_trees(tmp_path):
    with pytest.raises(InputError, match=r"expected left/\*\.png and right/\*\.png or .*; found an empty folder"):
        folder(tmp_path)
    with pytest.raises(InputError, match="unknown split 'train'; expected one of all"):
        folder(tmp_path, split="train")


@needs_shared
def test_real_pairs():
    demo = folder(SHARED / "data" / "demo")
    assert [sample.name for sample in demo] == ["kitti_street", "playtable"]
    assert folder(SHARED / "data" / "real" / "sceneflow")[0].disparity.shape == (540, 960)
