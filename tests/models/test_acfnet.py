"""The uniform form of AcfNet, of which there is no recording."""

import pytest

from stereokit import load_published
from tests.golden import published_state, save_checkpoint
from tests.shared import needs_shared


@needs_shared
@pytest.mark.slow
def test_weights_without_confidence_are_the_uniform_form(tmp_path):
    state = {key: value for key, value in published_state("acfnet").items() if not key.startswith("cmn.")}
    model = load_published(save_checkpoint(state, tmp_path / "published.ckpt"))
    assert model.config["name"] == "acfnet_uniform"
    assert sum(p.numel() for p in model.parameters()) == 5_226_912 - 192
