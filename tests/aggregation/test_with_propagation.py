import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, WithPropagation, build_model
from stereokit.layers import affinity_propagate
from tests.aggregation.test_with_offsets import BASES, OFFERED, SMALL


@pytest.mark.parametrize("name", BASES)
def test_each_head_of_any_base_spreads(name):
    aggregation = WithPropagation(base={"name": name, **SMALL.get(name, {})}, **OFFERED, steps=2)
    volume, guides = torch.randn(2, 4, 16, 16, 32), {4: torch.randn(2, 3, 16, 32)}
    heads = aggregation(volume, guides)
    assert len(heads) == len(aggregation.loss_weights)
    sum(head.square().sum() for head in heads).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in aggregation.parameters())


def test_the_logits_spread_by_the_affinity_of_what_the_head_sees():
    base = {"name": "stacked_hourglass", "channels": 2}
    aggregation = WithPropagation(base=base, in_channels=3, planes=8, steps=3, centre="own").eval()
    seen = []
    head = aggregation.base.head3
    head.register_forward_hook(lambda _module, given, out: seen.append((given[0], out)))
    aggregation(torch.randn(1, 3, 8, 8, 8), {})
    ((x, out),) = seen
    assert_close(out, affinity_propagate(head.logits(x), head.affinity(x), steps=3, centre="own"))


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ConfigError, match=r"'with_propagation' wants a base whose heads are 3D.*'inverted_residual'"):
        build_model("coex", aggregation={"name": "with_propagation", "base": "inverted_residual"})
    with pytest.raises(ConfigError, match="steps=0"):
        WithPropagation(base="hourglass", in_channels=1, planes=8, steps=0)
