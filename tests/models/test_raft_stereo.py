"""What is RAFT-Stereo's own."""

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import ConfigError, build_model

NAMES = ["raft_stereo", "raft_stereo_realtime"]


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_there_is_a_prediction_after_each_iteration_with_weights_that_grow(iterations):
    model = build_model("raft_stereo_realtime", iterations=iterations)
    output = model(*torch.rand(2, 1, 3, 64, 64))
    assert len(output.predictions) == iterations
    assert {p.stride for p in output.predictions} == {1}
    weights = model.loss_weights
    assert weights[-1] == 1
    assert list(weights) == sorted(weights)
    assert iterations == 1 or weights[0] == pytest.approx(0.9**15)


@pytest.mark.parametrize("name", NAMES)
def test_both_forms_of_the_lookup_agree(name):
    torch.manual_seed(0)
    models = [build_model(name, test_iterations=2, lookup=form).eval() for form in ("volume", "on_demand")]
    models[1].load_state_dict(models[0].state_dict())
    images = torch.rand(2, 1, 3, 64, 96)
    with torch.inference_mode():
        one, other = (model(*images).disparity for model in models)
    assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_more_iterations_go_on_from_fewer():
    """The n-th prediction in training mode is what n iterations give in eval mode."""
    model = build_model("raft_stereo_realtime", iterations=3)
    images = torch.rand(2, 1, 3, 64, 64)
    with torch.no_grad():
        each = model.train()(*images).predictions
        for count in (1, 2, 3):
            model.test_iterations = count
            assert_close(model.eval()(*images).disparity, each[count - 1].disparity, rtol=1e-3, atol=1e-3)


def test_batch_norms_stay_as_they_are():
    model = build_model("raft_stereo_realtime", iterations=1).train()
    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    before = [norm.running_mean.clone() for norm in norms]
    model(*torch.rand(2, 2, 3, 64, 64))
    assert len(norms) > 20
    assert all(torch.equal(norm.running_mean, mean) for norm, mean in zip(norms, before, strict=True))


def test_nothing_flows_back_through_the_disparity():
    """Only the last change reaches the head's weights through the flow: twice the iterations, no longer path."""
    model = build_model("raft_stereo_realtime", iterations=2).train()
    for parameter in model.update.head.parameters():
        nn.init.zeros_(parameter)
    output = model(*torch.rand(2, 1, 3, 64, 64))
    output.predictions[0].disparity.sum().backward(retain_graph=True)
    first = model.update.head[2].bias.grad.clone()
    model.zero_grad()
    output.predictions[1].disparity.sum().backward()
    assert_close(model.update.head[2].bias.grad, first, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [0, -1, 1.5, True])
def test_iterations_are_whole_and_positive(name, count):
    with pytest.raises(ConfigError, match="iterations"):
        build_model(name, test_iterations=count)
    with pytest.raises(ConfigError, match="iterations"):
        build_model(name, iterations=count)
