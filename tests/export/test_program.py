import pytest
import torch

from stereokit import ConfigError, InputError, Predictor
from stereokit.errors import CheckpointError
from stereokit.export import export_program
from stereokit.export.checking import random_pair
from tests.export.networks import Untrue


def test_the_program_runs_without_stereokit(tiny, tmp_path):
    report = export_program(tiny, tmp_path / "tiny.pt2")
    assert report.metadata.max_disparity == 16
    left, right = random_pair(45, 70)
    disparity, confidence = torch.export.load(tmp_path / "tiny.pt2").module()(left, right)
    torch.testing.assert_close(disparity, tiny(left, right).disparity)
    torch.testing.assert_close(confidence, tiny(left, right).confidence)
    with pytest.raises(CheckpointError, match=r"is a program of torch\.export, which torch\.export\.load reads"):
        Predictor(tmp_path / "tiny.pt2")


def test_bad_requests_are_refused_and_leave_nothing(tiny, tmp_path):
    with pytest.raises(InputError, match=r"does not end in \.pt2"):
        export_program(tiny, tmp_path / "a.onnx")
    with pytest.raises(ConfigError, match=r"wrong and was not kept"):
        export_program(Untrue(), tmp_path / "a.pt2")
    assert not list(tmp_path.iterdir())
