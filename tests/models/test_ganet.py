import pytest
import torch

from stereokit import build_model, load_published
from stereokit.guidance import GuidancePoint
from stereokit.guidance.semi_global import SemiGlobalGuidance
from tests.golden import published_state, save_checkpoint
from tests.shared import needs_shared

RECORDED = {"ganet_deep": "ganet_deep", "ganet_11": "ganet11"}


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDED)
def test_a_published_checkpoint_is_recognised_and_runs(name, tmp_path):
    state = published_state(RECORDED[name], (0.5, 0.75))
    model = load_published(save_checkpoint(state, tmp_path / "published.ckpt"))
    assert model.config["name"] == name
    used = {key: value for key, value in state.items() if not key.startswith("cost_agg.deconv0b.")}
    assert sum(v.numel() for v in model.state_dict().values()) == sum(v.numel() for v in used.values())
    # lower is better there
    last = max(number for number in range(3) if f"cost_agg.disp{number}.conv32x1.weight" in state)
    assert torch.equal(model.aggregation.heads[last].weight, -state[f"cost_agg.disp{last}.conv32x1.weight"])
    assert torch.equal(model.regression.of_logits[1].weight, state["guidance.weight_lg1.1.weight"])


@pytest.mark.parametrize(("name", "strides"), [("ganet_deep", [3, 6, 6, 3, 6, 6, 3]), ("ganet_11", [3, 6, 6, 3])])
def test_it_is_guided_at_the_published_places(name, strides):
    with torch.device("meta"):
        model = build_model(name)
    points = [m for m in model.aggregation.modules() if isinstance(m, GuidancePoint)]
    assert all(isinstance(point.block, SemiGlobalGuidance) for point in points)
    assert [point.stride for point in points] == strides


def test_its_candidates_include_the_end():
    with torch.device("meta"):
        model = build_model("ganet_deep", max_disparity=96)
    assert model.cost.planes == 33
    logits = torch.zeros(1, 33, 2, 3)
    logits[:, -1] = 50
    upsampled = model.upsampler(logits, {})
    assert upsampled.shape == (1, 97, 6, 9)
    # the last of 33 planes lies in the middle of the last three levels, 94 to 96
    expected = (upsampled.softmax(1) * torch.arange(97.0).reshape(-1, 1, 1)).sum(1)
    assert ((expected > 94.5) & (expected < 95.8)).all()
