import numpy as np
import pytest
from torch import nn

from stereokit import InputError
from stereokit.data import write_image
from stereokit.export.calibration import find_pairs


def test_pairs_of_files_are_spread_over_what_there_is(tmp_path):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for i in range(6):
            write_image(tmp_path / side / f"{i}.png", np.full((40, 50, 3), i, np.uint8))
    source = [str(tmp_path / "left"), str(tmp_path / "right")]
    pairs = find_pairs(source, 3, nn.Identity(), None)
    assert list(pairs) == ["0", "2", "4"]
    assert [left.unique().tolist() for left, _ in pairs.values()] == [[0], [2], [4]]
    assert len(find_pairs(source, 99, nn.Identity(), None)) == 6


def test_rendered_scenes_have_the_size_and_differ():
    pairs = list(find_pairs(["synthetic"], 2, nn.Identity(), (48, 64)).values())
    assert [left.shape for left, _ in pairs] == [(1, 3, 48, 64)] * 2
    assert not pairs[0][0].equal(pairs[1][0])


def test_what_is_no_source_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"got 3 names"):
        find_pairs(["a", "b", "c"], 1, nn.Identity(), None)
    with pytest.raises(InputError, match=r"at least 1 pair"):
        find_pairs(["synthetic"], 0, nn.Identity(), None)
    with pytest.raises(InputError):
        find_pairs(["nonsense"], 1, nn.Identity(), None)
