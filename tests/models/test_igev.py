"""What IGEV-Stereo and RT-IGEV have of their own."""

import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, build_model

NAMES = ["igev", "rt_igev"]


@pytest.mark.parametrize("name", NAMES)
def test_the_first_disparity_is_trained_beside_those_of_the_iterations(name):
    model = build_model(name, max_disparity=64, iterations=3)
    output = model(*torch.rand(2, 1, 3, 64, 64))
    assert len(output.predictions) == 4
    assert [p.distribution is None for p in output.predictions] == [False, True, True, True]
    assert {p.stride for p in output.predictions} == {1}
    assert model.loss_weights == pytest.approx((1.0, 0.9**15, 0.9**7.5, 1.0))


@pytest.mark.parametrize("name", NAMES)
def test_iterations_go_on_from_the_first_disparity(name):
    """Without a change, what comes out is the volume's own disparity, upsampled."""
    torch.manual_seed(0)
    model = build_model(name, max_disparity=64, test_iterations=3).eval()
    for parameter in model.update.head[2].parameters():
        torch.nn.init.zeros_(parameter)
    torch.nn.init.zeros_(model.classifier.weight)
    with torch.inference_mode():
        disparity = model(*torch.rand(2, 1, 3, 64, 96)).disparity
    # all 16 planes alike: their mean, but for zeros that come in from outside
    assert_close(disparity[:, 4:-4, 4:-4], torch.full((1, 56, 88), 4 * 7.5))


@pytest.mark.parametrize("name", NAMES)
def test_an_iteration_does_not_train_the_first_disparity(name):
    model = build_model(name, max_disparity=64, iterations=1)
    output = model(*torch.rand(2, 1, 3, 64, 64))
    output.predictions[-1].disparity.sum().backward()
    assert model.classifier.weight.grad is None
    assert model.geometry.up1.weight.grad is not None


def test_both_forms_of_the_lookup_agree():
    torch.manual_seed(0)
    models = [
        build_model("igev", max_disparity=64, test_iterations=2, lookup=f).eval() for f in ("volume", "on_demand")
    ]
    models[1].load_state_dict(models[0].state_dict())
    images = torch.rand(2, 1, 3, 64, 96)
    with torch.inference_mode():
        one, other = (model(*images).disparity for model in models)
    assert_close(one, other, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("argument", "value"), [("max_disparity", 48), ("iterations", 0), ("test_iterations", 1.5)])
def test_what_can_not_be_is_refused(name, argument, value):
    with pytest.raises(ConfigError, match=argument):
        build_model(name, **{argument: value})
