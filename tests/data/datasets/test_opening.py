import pytest

from stereokit.data.datasets import DATASETS, open_dataset
from stereokit.errors import ConfigError, InputError
from tests.data.datasets import trees


def test_kinds():
    assert DATASETS.names() == [
        "booster", "crestereo", "drivingstereo", "eth3d", "folder", "instereo2k", "kitti2012", "kitti2015", "kitti_raw",
        "middlebury2014", "middlebury2021", "middlebury_older", "middlebury_v3", "sceneflow", "sintel", "spring",
        "tartanair", "virtual_kitti2",
    ]  # fmt: skip


def test_spec(tmp_path):
    trees.kitti2012(tmp_path, range(11))
    assert len(open_dataset(f"kitti2012:{tmp_path}")) == 11
    assert len(open_dataset(f"kitti2012:{tmp_path}", split="val")) == 2
    assert len(open_dataset(f"kitti2012/train:{tmp_path}")) == 9
    assert open_dataset(f"kitti2012/train,views=grey:{tmp_path}").split == "train"
    assert len(open_dataset(f"kitti2012:{tmp_path}", views="grey")) == 11


def test_a_place_with_a_colon(tmp_path):
    trees.kitti2012(tmp_path / "C:" / "data")
    assert len(open_dataset(f"kitti2012:{tmp_path}/C:/data")) == 2


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        (
            "kitti2012",
            InputError,
            "names no data set; expected KIND:ROOT, with KIND one of booster, crestereo",
        ),
        ("kitti2012:", InputError, "names no data set"),
        (":/data", InputError, "names no data set"),
        ("kiti2012:/data", ConfigError, "unknown data set 'kiti2012'; did you mean 'kitti2012'"),
        ("kitti2012,view=grey:/data", ConfigError, "takes no argument 'view'; did you mean 'views'"),
        ("kitti2012,grey:/data", InputError, "expected an option as NAME=VALUE, got 'grey'"),
        ("kitti2012/valid:/data", InputError, "unknown split 'valid'; expected one of training, train, val"),
        ("kitti2012:/no/such/place", InputError, "found nothing, it does not exist"),
    ],
)
def test_what_can_not_be_opened(spec, error, message):
    with pytest.raises(error, match=message):
        open_dataset(spec)


def test_a_place_of_another_kind_says_of_which(tmp_path):
    trees.kitti2012(tmp_path)
    with pytest.raises(InputError, match=r"expected training/image_2/.*; it can be opened as kitti2012$"):
        open_dataset(f"kitti2015:{tmp_path}")


@pytest.mark.parametrize("part", ["image_0", "image_1", "disp_occ", "disp_noc", "calib"])
def test_files_that_are_missing(tmp_path, part):
    trees.kitti2012(tmp_path)
    name = "000001.txt" if part == "calib" else "000001_10.png"
    (tmp_path / "training" / part / name).unlink()
    with pytest.raises(InputError, match=rf"is not whole: 1 of its files are missing, .* 'training/{part}/{name}'"):
        open_dataset(f"kitti2012:{tmp_path}")
    assert len(open_dataset(f"kitti2012:{tmp_path}", allow_missing=True)) == 2


def test_files_that_a_list_names_and_are_missing(tmp_path):
    trees.save(tmp_path / "pairs.txt", "views/l.png views/r.png")
    with pytest.raises(InputError, match=r"2 of its files are missing, the first is .views/l\.png"):
        open_dataset(f"folder:{tmp_path}/pairs.txt")
