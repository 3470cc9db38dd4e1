import csv
import json

import pytest

from stereokit.errors import InputError
from stereokit.evaluation import evaluate
from stereokit.evaluation.results import result_paths
from stereokit.files import make_folder
from tests.evaluation.scenes import constant, save_kitti, save_scene


@pytest.fixture
def evaluation(tmp_path):
    save_scene(tmp_path / "mine", "a, with a comma", 6)
    save_scene(tmp_path / "mine", "b", 9)
    save_kitti(tmp_path / "kitti", "2012", "training")
    return evaluate(constant(7.0), [f"folder:{tmp_path / 'mine'}", f"kitti2012:{tmp_path / 'kitti'}"])


def test_files_hold_the_numbers_exactly(evaluation, tmp_path):
    written = evaluation.save(tmp_path / "new" / "out")
    assert written == result_paths(tmp_path / "new" / "out")
    data = json.loads(written[0].read_text())
    datasets, pairs = (list(csv.DictReader(path.open(newline=""))) for path in written[1:])
    assert [float(row["epe"]) for row in datasets] == [d.metrics["epe"] for d in evaluation.datasets]
    assert datasets[0]["epe_noc"] == ""
    assert float(datasets[1]["epe_noc"]) == 2
    results = [pair for d in evaluation.datasets for pair in d.pairs]
    assert [row["pair"] for row in pairs] == [pair.name for pair in results]
    assert [float(row["bad_1"]) for row in pairs] == [pair.metrics["bad_1"] for pair in results]
    assert not any("per_image" in column or column.startswith("images") for column in pairs[0])
    assert [pair["name"] for d in data["datasets"] for pair in d["pairs"]] == [pair.name for pair in results]


def test_existing_files_are_kept_unless_told_otherwise(evaluation, tmp_path):
    taken = result_paths(tmp_path)[2]
    taken.write_text("precious")
    with pytest.raises(InputError, match="exists already"):
        evaluation.save(tmp_path)
    assert taken.read_text() == "precious"
    assert not result_paths(tmp_path)[0].exists()
    evaluation.save(tmp_path, overwrite=True)
    assert taken.read_text() != "precious"


def test_a_folder_that_can_not_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be made"):
        make_folder(tmp_path / "file" / "below")
