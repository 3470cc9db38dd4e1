import numpy as np
import pytest

from stereokit.data import read_kitti_png
from stereokit.data.datasets import open_dataset
from stereokit.data.images import read_samples
from stereokit.errors import InputError
from stereokit.evaluation import KittiSubmission, evaluate
from tests.evaluation.scenes import SIZE, constant, save_kitti, save_scene


@pytest.mark.parametrize(("year", "folder"), [("2012", "."), ("2015", "disp_0")])
def test_the_layout_is_that_of_the_server(tmp_path, year, folder):
    save_kitti(tmp_path / "kitti", year, "testing", [0, 7])
    spec = f"kitti{year}/testing:{tmp_path / 'kitti'}"

    def match(left, right):
        disparity = np.full(left.shape[:2], 12.25)
        disparity[0, 0] = np.nan
        return disparity

    evaluate(match, [spec], observers=[KittiSubmission(tmp_path / "out", open_dataset(spec))])
    files = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.png"))
    assert files == [(f"{folder}/" if folder != "." else "") + name for name in ("000000_10.png", "000007_10.png")]
    path = tmp_path / "out" / folder / "000007_10.png"
    assert read_samples(path).dtype == np.uint16
    stored = read_kitti_png(path)
    assert stored.shape == SIZE
    assert np.isnan(stored[0, 0])
    assert (stored.ravel()[1:] == 12.25).all()


def test_existing_files_and_other_data_sets_are_refused(tmp_path):
    save_kitti(tmp_path / "kitti", "2015", "testing")
    dataset = open_dataset(f"kitti2015/testing:{tmp_path / 'kitti'}")
    (tmp_path / "out/disp_0").mkdir(parents=True)
    taken = tmp_path / "out/disp_0/000001_10.png"
    taken.write_text("precious")
    with pytest.raises(InputError, match="exists already"):
        KittiSubmission(tmp_path / "out", dataset)
    KittiSubmission(tmp_path / "out", dataset, overwrite=True)
    save_scene(tmp_path / "mine", "a")
    with pytest.raises(InputError, match="kitti2012 or kitti2015, got folder"):
        KittiSubmission(tmp_path / "other", open_dataset(f"folder:{tmp_path / 'mine'}"))


def test_a_disparity_beyond_the_encoding_is_an_error(tmp_path):
    save_kitti(tmp_path / "kitti", "2015", "testing")
    spec = f"kitti2015/testing:{tmp_path / 'kitti'}"
    with pytest.raises(InputError, match=r"255\.996"):
        evaluate(constant(300), [spec], observers=[KittiSubmission(tmp_path / "out", open_dataset(spec))])
    assert not list((tmp_path / "out").rglob("*.png"))
