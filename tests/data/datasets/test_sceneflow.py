import numpy as np
import pytest

from stereokit.data.datasets.sceneflow import read_sceneflow_disparity, sceneflow
from stereokit.data.pfm import write_pfm
from stereokit.errors import InputError
from tests.data.datasets import trees
from tests.shared import SHARED, needs_shared

THINGS = ("TRAIN/A/0000", "TEST/B/0001")
MONKAA = ("a_rain_of_stones_x2",)
DRIVING = ("15mm_focallength/scene_forwards/fast",)


def write(frames, disparities, scenes, suffix=".png"):
    for scene in scenes:
        trees.save_pair(frames / scene / "left" / f"0006{suffix}", frames / scene / "right" / f"0006{suffix}")
        trees.save(disparities / scene / "left" / "0006.pfm", trees.DISPARITY)


def as_distributed(root):
    for name, scenes in (("FlyingThings3D", THINGS), ("Monkaa", MONKAA), ("Driving", DRIVING)):
        write(root / name / "frames_finalpass", root / name / "disparity", scenes)


def as_many_projects_keep_it(root):
    for prefix, truth, scenes in (
        ("", "frames_disparity", THINGS),
        ("monkaa_", "monkaa_disparity", MONKAA),
        ("driving_", "driving_disparity", DRIVING),
    ):
        write(root / f"{prefix}frames_finalpass", root / truth, scenes)


def all_in_one(root):
    write(root / "frames_finalpass_webp", root / "disparity", (*THINGS, *MONKAA, *DRIVING), ".webp")


@pytest.mark.parametrize("layout", [as_distributed, as_many_projects_keep_it, all_in_one])
def test_layouts(tmp_path, layout):
    layout(tmp_path)
    test, train, both = (sceneflow(tmp_path, split=split) for split in ("test", "train", "all"))
    assert (len(test), len(train), len(both)) == (1, 3, 4)
    assert "TEST/B/0001/left/0006" in test.entries[0].name
    for sample in both:
        trees.assert_pair(sample)
        trees.assert_truth(sample)
        assert sample.nonocc is None
    assert [len(sceneflow(tmp_path, split="train", part=part)) for part in ("flyingthings3d", "monkaa", "driving")] == [
        1,
        1,
        1,
    ]


def test_an_empty_split_names_those_with_pairs(tmp_path):
    write(tmp_path / "frames_finalpass", tmp_path / "disparity", ["TEST/A/0000"])
    assert len(sceneflow(tmp_path)) == 1
    with pytest.raises(InputError, match=r"split 'train' of sceneflow is empty in .*of split 'test'$"):
        sceneflow(tmp_path, split="train")


def test_passes_are_kept_apart(tmp_path):
    as_many_projects_keep_it(tmp_path)
    write(tmp_path / "frames_cleanpass", tmp_path / "other", THINGS[:1])
    assert len(sceneflow(tmp_path, split="all", image_pass="cleanpass")) == 1
    assert len(sceneflow(tmp_path, split="all")) == 4


def test_the_right_view_has_its_own_truth_where_it_is_there(tmp_path):
    as_many_projects_keep_it(tmp_path)
    right = np.full(trees.SHAPE, 7, np.float32)
    for path in sorted(tmp_path.glob("frames_disparity/**/left/*.pfm")):
        trees.save(path.parent.with_name("right") / path.name, -right)
    for sample in sceneflow(tmp_path, split="all"):
        trees.assert_truth(sample)
        if "TEST" in sample.name or "TRAIN" in sample.name:
            np.testing.assert_array_equal(sample.right_disparity, right)
        else:
            assert sample.right_disparity is None
    trees.save(path.parent.with_name("right") / "other.pfm", right)
    (path.parent.with_name("right") / path.name).unlink()
    assert sceneflow(tmp_path, split="all").missing_files() == []
    assert sum(sample.right_disparity is None for sample in sceneflow(tmp_path, split="all")) == 3


@pytest.mark.parametrize("sign", [1, -1])
def test_the_subset_and_its_negative_disparity(tmp_path, sign):
    base = tmp_path / "FlyingThings3D_subset"
    for number, part in enumerate(("train", "val")):
        views = [base / part / "image_clean" / view / "0000000.png" for view in ("left", "right")]
        trees.save_pair(*views, number)
        trees.save(base / part / "disparity" / "left" / "0000000.pfm", (sign * trees.DISPARITY).astype(np.float32))
        occluded = np.where(np.arange(9) < 4, 255, 0).astype(np.uint8) * np.ones((6, 1), np.uint8)
        trees.save(base / part / "disparity_occlusions" / "left" / "0000000.png", occluded)
        trees.save(base / part / "disparity_occlusions" / "right" / "0000000.png", occluded[:, ::-1].copy())
    for number, split in enumerate(("train", "test")):
        (sample,) = sceneflow(tmp_path, split=split, image_pass="cleanpass")
        trees.assert_pair(sample, number)
        trees.assert_truth(sample)
        np.testing.assert_array_equal(sample.nonocc, np.broadcast_to(np.arange(9) >= 4, (6, 9)))
        np.testing.assert_array_equal(sample.right_nonocc, sample.nonocc[:, ::-1])


def test_one_file_has_one_sign(tmp_path):
    write_pfm(tmp_path / "a.pfm", [[1.0, -1.0, np.nan]])
    with pytest.raises(InputError, match="disparity of both signs"):
        read_sceneflow_disparity(tmp_path / "a.pfm")


def test_flat(tmp_path):
    trees.save_pair(tmp_path / "left" / "0.png", tmp_path / "right" / "0.png")
    trees.save(tmp_path / "disparity" / "left" / "0.pfm", trees.DISPARITY)
    (sample,) = sceneflow(tmp_path)
    assert sample.name == "left/0"
    trees.assert_truth(sample)


def test_a_missing_truth_is_noticed(tmp_path):
    as_distributed(tmp_path)
    gone = tmp_path / "FlyingThings3D" / "disparity" / THINGS[1] / "left" / "0006.pfm"
    gone.unlink()
    assert sceneflow(tmp_path).missing_files() == [gone]


def test_other_trees(tmp_path):
    (tmp_path / "frames_cleanpass").mkdir()
    with pytest.raises(InputError, match=r"expected frames_finalpass/TEST.*; found frames_cleanpass/"):
        sceneflow(tmp_path)
    with pytest.raises(InputError, match="unknown image_pass 'clean'; expected one of cleanpass, finalpass"):
        sceneflow(tmp_path, image_pass="clean")
    with pytest.raises(InputError, match="unknown part"):
        sceneflow(tmp_path, part="sintel")


@needs_shared
def test_real_sceneflow():
    (sample,) = sceneflow(SHARED / "data" / "real" / "sceneflow")
    assert sample.disparity.shape == (540, 960)
    for truth in (sample.disparity, sample.right_disparity):
        assert 1 < np.nanmin(truth) < np.nanmax(truth) < 76
