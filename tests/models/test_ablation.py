from collections import Counter

import pytest
import torch

from stereokit import build_model
from stereokit.guidance import GuidancePoint, NoGuidance
from stereokit.models.ablation import ABLATION


@pytest.mark.parametrize("row", ABLATION, ids=lambda row: f"{row.table}-{row.model}-{row.epe}")
def test_every_row_runs_forward_and_backward(row):
    model = build_model(row.model, **row.overrides)
    left, right = torch.rand(2, 2, 3, 32, 64)
    output = model(left, right)
    disparities = (output.disparity, *output.auxiliary)
    sum(weight * d.mean() for weight, d in zip((1, *model.auxiliary_weights), disparities, strict=True)).backward()
    assert all(d.shape == (2, 32, 64) and d.isfinite().all() for d in disparities)
    # no weight is left out of the forward pass
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    assert all(p.grad.isfinite().all() for p in model.parameters())
    with torch.no_grad():
        assert model.eval()(left[:1], right[:1]).disparity.isfinite().all()


def test_the_tables_are_whole():
    assert Counter((row.table, row.model) for row in ABLATION) == {
        ("all", "psmnet"): 10,
        ("all", "coex"): 10,
        ("add", "coex"): 3,
        ("graph", "coex"): 2,
    }


@pytest.mark.parametrize("table", ["all", "add", "graph"])
def test_the_rows_of_a_table_differ(table):
    rows = [(row.model, dict(row.overrides)) for row in ABLATION if row.table == table]
    assert all(rows.count(row) == 1 for row in rows)


def test_the_best_row_is_coex():
    best = min((row for row in ABLATION if row.model == "coex"), key=lambda row: row.epe)
    config = build_model(best.model, **best.overrides).config
    assert {**config, "name": "coex"} == build_model("coex").config


@pytest.mark.parametrize("row", ABLATION, ids=str)
def test_rows_are_built_as_they_say(row):
    model = build_model(row.model, **row.overrides)
    guided = [
        point.stride
        for point in model.aggregation.modules()
        if isinstance(point, GuidancePoint) and not isinstance(point.block, NoGuidance)
    ]
    places = {"none": [], "one": [4], "full": [4, 8, 16, 32, 16, 8]}
    guidance = row.overrides["guidance"]
    assert guided == places["none" if guidance == "none" else row.overrides["guidance_at"]]
    cost = row.overrides.get("cost", "correlation")
    assert (model.cost.out_channels == 1) == (cost == "correlation")
    regression = row.overrides.get("regression", {"k": 2, "test_k": None})
    assert model.regression.k == regression["k"]
    assert model.regression.test_k == (regression["test_k"] or regression["k"])


def test_rows_can_not_be_changed():
    with pytest.raises(TypeError):
        ABLATION[0].overrides["cost"] = "correlation"
