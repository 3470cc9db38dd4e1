import json

import cv2
import numpy as np
import pytest

from stereokit.cli import main
from stereokit.data import write_image
from stereokit.data.synthetic import SyntheticScenes


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    scene = SyntheticScenes(seed=0, size=(240, 320), max_disparity=40, photometric=0)[3]
    for name in ("left", "right"):
        write_image(folder / f"{name}.png", getattr(scene, name))
    return str(folder / "left.png"), str(folder / "right.png")


def test_a_good_pair_is_good(pair, capsys):
    assert main(["check", *pair]) == 0
    assert capsys.readouterr().out == "good: nothing is wrong with this pair\n"


def test_swapped_views_are_unusable_and_it_says_what_to_do(pair, capsys):
    assert main(["check", *reversed(pair)]) == 2
    assert "swap" in capsys.readouterr().out
    assert main(["check", *reversed(pair), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["findings"][0]["name"] == "swapped"


def test_a_range_that_is_too_small_is_a_warning(pair, capsys):
    assert main(["check", *pair, "--max-disparity", "10"]) == 1
    assert "--scale" in capsys.readouterr().out


def test_the_picture_is_written_once(pair, tmp_path, capsys):
    picture = str(tmp_path / "matches.png")
    assert main(["check", *pair, "--picture", picture]) == 0
    assert cv2.imread(picture).shape == (240, 640, 3)
    assert main(["check", *pair, "--picture", picture]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["check", *pair, "--picture", picture, "--overwrite"]) == 0


def test_predict_warns_of_views_that_do_not_match(pair, tmp_path, capsys):
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    write_image(tmp_path / "noise.png", noise)
    assert main(["predict", pair[0], str(tmp_path / "noise.png"), "--out", str(tmp_path / "out")]) == 0
    assert "'stereokit check' tells why" in capsys.readouterr().err
