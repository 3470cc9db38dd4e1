import pytest
import torch
from torch.testing import assert_close

from stereokit import build_model
from stereokit.contracts import Distribution


def test_its_weights_serve_any_range():
    model = build_model("pdsnet", max_disparity=64)
    wider = build_model(model.config, max_disparity=192).eval()
    wider.load_state_dict(model.state_dict())
    with torch.inference_mode():
        output = wider(*torch.rand(2, 1, 3, 64, 70), return_logits=True)
    assert output.logits.shape == (1, 96, 64, 128)
    assert output.distribution.spacing == 2.0


def test_its_planes_are_the_even_disparities():
    model = build_model("pdsnet", max_disparity=128).eval()

    def sure(_module, _inputs, output):
        logits = torch.full_like(output[-1], -50.0)
        logits[:, 20] = 50.0
        return (logits,)

    model.aggregation.register_forward_hook(sure)
    with torch.inference_mode():
        output = model(*torch.rand(2, 1, 3, 64, 100), return_logits=True)
    assert_close(output.disparity, torch.full((1, 64, 100), 40.0))
    assert isinstance(output.distribution, Distribution)
    assert (output.distribution.stride, output.distribution.first) == (1, 0.0)


@pytest.mark.parametrize(("max_disparity", "least"), [(64, 65), (128, 32)])
def test_a_single_voxel_has_no_statistics(max_disparity, least):
    assert build_model("pdsnet", max_disparity=max_disparity).least_size == least
