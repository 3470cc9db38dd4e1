import numpy as np
import pytest

from stereokit.cli import main
from stereokit.cli.synth import write_scenes
from stereokit.data.datasets import open_dataset
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import InputError
from stereokit.training import load_recipe

OPTIONS = ["--count", "3", "--seed", "3", "--size", "40", "64", "--max-disparity", "16"]


def test_what_is_written_is_read_back(tmp_path, capsys):
    assert main(["synth", *OPTIONS, "--out", str(tmp_path / "new" / "scenes")]) == 0
    assert "wrote 3 pairs; to be read as sceneflow:" in capsys.readouterr().out
    dataset = open_dataset(f"sceneflow:{tmp_path / 'new' / 'scenes'}")
    scenes = SyntheticScenes(seed=3, size=(40, 64), max_disparity=16, count=3)
    assert len(dataset) == 3
    for read, drawn in zip(dataset, scenes, strict=True):
        for part in ("left", "right", "disparity", "right_disparity"):
            np.testing.assert_array_equal(getattr(read, part), getattr(drawn, part))


def test_scenes_of_a_recipe(tmp_path, capsys):
    recipe = load_recipe("synthetic-finetune")
    options = ["synth", "--count", "1", "--recipe", recipe.name, "--seed", "3"]
    assert main([*options, "--out", str(tmp_path / "own")]) == 0
    own = open_dataset(f"sceneflow:{tmp_path / 'own'}")[0]
    assert own.left.shape == (320, 640, 3)
    np.testing.assert_array_equal(own.left, recipe.rendered_scenes(seed=3)[0].left)
    assert main([*options, "--size", "48", "160", "--out", str(tmp_path / "small")]) == 0
    small = open_dataset(f"sceneflow:{tmp_path / 'small'}")[0]
    np.testing.assert_array_equal(small.left, recipe.rendered_scenes(seed=3, size=(48, 160))[0].left)
    assert main(["synth", "--count", "1", "--recipe", "sceneflow", "--out", str(tmp_path / "none")]) == 2
    assert "'sceneflow' renders no scenes: it trains on sceneflow/train:ROOT" in capsys.readouterr().err


def test_splits_and_long_sequences(tmp_path, capsys):
    def stand_in(index):
        return samples[index % 2]

    scenes = SyntheticScenes(seed=3, size=(32, 48), max_disparity=8, count=2)
    samples = [scenes[0], scenes[1]]

    class Many:
        __getitem__ = staticmethod(stand_in)

        def __len__(self):
            return 103

    write_scenes(Many(), tmp_path, split="train")
    train = open_dataset(f"sceneflow/train:{tmp_path}")
    assert len(train) == 103
    assert train.entries[102].name.endswith("TRAIN/A/0001/left/0002")
    np.testing.assert_array_equal(train[102].left, samples[0].left)
    write_scenes(scenes, tmp_path)
    assert len(open_dataset(f"sceneflow:{tmp_path}")) == 2
    with pytest.raises(InputError, match="exists already"):
        write_scenes(scenes, tmp_path)
    with pytest.raises(InputError, match="unknown split 'val'"):
        write_scenes(scenes, tmp_path, split="val")
    assert main(["synth", *OPTIONS, "--out", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_errors_are_one_line(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["synth", *OPTIONS, "--out", str(tmp_path / "file")]) == 2
    assert main(["synth", "--count", "0", "--out", str(tmp_path / "a")]) == 2
    assert main(["synth", *OPTIONS, "--out", str(tmp_path / "a"), "--textures", str(tmp_path)]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stereokit synth:")]
    assert "can't be made" in lines[0]
    assert "count of at least 1" in lines[1]
    assert "no images to use as textures" in lines[2]
