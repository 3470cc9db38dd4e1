import pytest
import torch
from torch import nn

from stereokit.builder import build_model
from stereokit.optimize import copy_state, prepare_for_training
from stereokit.training.statistics import SharedBatchStatistics


@pytest.fixture
def model():
    torch.manual_seed(0)
    model = build_model("coex", max_disparity=32)
    with torch.no_grad():
        # statistics of its own
        model.train()(*torch.rand(2, 2, 3, 64, 64))
    return model.eval()


def test_sharing_statistics_changes_nothing_but_the_norms(model):
    images = torch.rand(2, 1, 3, 64, 96)
    parameters = dict(model.named_parameters())
    before, names = model(*images).disparity, list(model.state_dict())
    norms = sum(isinstance(module, nn.modules.batchnorm._BatchNorm) for module in model.modules())
    SharedBatchStatistics.share(model)
    assert sum(isinstance(module, nn.SyncBatchNorm) for module in model.modules()) == norms
    assert torch.equal(model(*images).disparity, before)
    assert list(model.state_dict()) == names
    assert all(parameter is parameters[name] for name, parameter in model.named_parameters())


def test_a_twin_that_shares_statistics_and_moves_gives_them_back(model):
    twin = prepare_for_training(model)
    kinds = [type(module) for module in model.modules()]
    SharedBatchStatistics.share(twin)
    # as a run on a GPU does: statistics of another place and value
    for module in twin.modules():
        if isinstance(module, nn.SyncBatchNorm):
            module.running_mean = module.running_mean + 0.01
    images = torch.rand(2, 1, 3, 64, 96)
    after = twin(*images).disparity
    assert not torch.equal(model(*images).disparity, after)
    copy_state(twin, model)
    assert torch.equal(model(*images).disparity, after)
    assert [type(module) for module in model.modules()] == kinds
