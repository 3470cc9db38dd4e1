import pytest

from stereokit import StereoModel, build_model
from stereokit.bench.summary import model_summary


@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet", "dispnetc", "stereonet_8x"])
def test_blocks_add_up_to_the_network(name: str) -> None:
    model = build_model(name)
    blocks = model_summary(model, 64, 96)
    assert sum(b.parameters for b in blocks) == sum(p.numel() for p in model.parameters())
    if isinstance(model, StereoModel):
        slots = ["backbone", "candidates", "cost", "aggregation", "regression", "upsampler"]
        slots += [f"coarse.{number}" for number in range(len(model.coarse))]
        slots += [f"refinements.{number}" for number in range(len(model.refinements))]
    else:
        slots = [name for name, _ in model.named_children()]
    assert [b.slot for b in blocks] == slots
    # nothing was computed, and the model is as it was
    assert all(p.device.type == "cpu" for p in model.parameters())


def test_multiply_adds_of_a_known_layer() -> None:
    model = build_model("coex", backbone={"name": "residual", "blocks": 0}, cost="concatenation", upsampler="bilinear")
    features = next(b for b in model_summary(model, 64, 96) if b.slot == "backbone")
    stem, head = 3 * 32 * 25, 32 * 32 * 9
    assert features.multiply_adds == 2 * (stem + head) * 32 * 48


def test_multiply_adds_grow_with_the_size() -> None:
    model = build_model("coex")
    small, large = (sum(b.multiply_adds for b in model_summary(model, s, s)) for s in (64, 128))
    assert large == pytest.approx(4 * small, rel=0.05)
