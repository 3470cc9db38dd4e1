import numpy as np
import pytest
import torch
from torch import Tensor, nn

from stereokit import ConfigError, InputError, Predictor, StereoOutput
from stereokit.evaluation import NetworkMatcher
from stereokit.inference.predictor import check_finite

IMAGE = np.zeros((40, 50, 3), np.uint8)


class Broken(nn.Module):
    def __init__(self, columns: int) -> None:
        super().__init__()
        self.columns = columns

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        disparity = torch.ones(len(left), *left.shape[-2:])
        disparity[..., : self.columns] = torch.nan
        return StereoOutput(disparity)


class Half:
    precision = "float16"
    device = torch.device("cpu")


def test_a_network_that_gives_nothing_finite_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"no finite disparity at any pixel, in float32 on cpu: its weights"):
        Predictor(Broken(50), "cpu")(IMAGE, IMAGE)
    with pytest.raises(InputError, match=r"in float16 on cpu.*use precision 'bfloat16' or 'float32'"):
        check_finite(np.full((2, 3), np.nan), Half())
    with pytest.raises(InputError, match="no finite disparity"):
        NetworkMatcher(Predictor(Broken(50), "cpu")).match_batch([IMAGE, IMAGE], [IMAGE, IMAGE])


def test_some_pixels_that_are_not_finite_are_counted() -> None:
    assert Predictor(Broken(10), "cpu")(IMAGE, IMAGE).invalid == 400


class Says(nn.Module):
    def __init__(self, output: object) -> None:
        super().__init__()
        self.output = output

    def forward(self, left: Tensor, right: Tensor) -> object:
        return self.output


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (torch.ones(1, 40, 50), "gave a Tensor; expected a StereoOutput"),
        (None, "gave a NoneType; expected a StereoOutput"),
        (StereoOutput(torch.ones(1, 1, 40, 50)), r"disparity of shape \(1, 1, 40, 50\); expected \(1, 40, 50\)"),
        (StereoOutput(torch.ones(1, 10, 12)), r"disparity of shape \(1, 10, 12\)"),
        (StereoOutput(torch.ones(1, 40, 50), confidence=torch.ones(1)), r"confidence of shape \(1,\)"),
        (StereoOutput(torch.ones(1, 40, 50, device="meta")), "meta device"),
        (StereoOutput(torch.ones(1, 40, 50).to_sparse()), "sparse"),
    ],
)
def test_a_network_of_ones_own_that_gives_something_else(output: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Predictor(Says(output), "cpu")(IMAGE, IMAGE)


@pytest.mark.parametrize("device", ["meta", "hpu", "xla", "nothing", "cuda:99", ""])
def test_devices_that_are_none(device: str) -> None:
    with pytest.raises(ConfigError, match="can't be used; use 'auto' or 'cpu'"):
        Predictor(Broken(1), device)
