"""Conversion held to what the published code does, with a checkpoint that the test makes by itself."""

import pytest
import torch
from torch import Tensor

from stereokit import StereoNetwork, build_model, load_published
from stereokit.weights.key_map import PUBLISHED
from tests.fuzz.networks import in_published_terms
from tests.golden import fill

CHOICES = [
    {"guidance": "gce", "guidance_at": "one"},
    {"guidance": "gce", "guidance_at": "full"},
    {"guidance": "none"},
    {"cost": "concatenation"},
]


def published(**choices: object) -> tuple[StereoNetwork, dict[str, Tensor]]:
    """A CoEx that computes what the authors' code does with a checkpoint, and the checkpoint.

    Their code feeds BGR images to what is normalised by the numbers of RGB: as ours does with images turned around.
    """
    network = build_model("coex", max_disparity=64, **choices).eval()
    shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    network.load_state_dict(fill(shapes, seed=1, norm=(0.8, 1.2)))
    [keys] = [format.keys for format in PUBLISHED if format.network == "coex"]
    state = in_published_terms(network.state_dict(), keys)
    return network, {f"stereo.{key}": value for key, value in state.items()}


@pytest.mark.parametrize("choices", CHOICES)
@pytest.mark.parametrize("order", ["bgr", "rgb"])
def test_it_computes_what_the_published_code_does(choices, order, tmp_path) -> None:
    network, state = published(**choices)
    torch.save({"state_dict": state}, tmp_path / "coex.ckpt")
    loaded = load_published(tmp_path / "coex.ckpt", channel_order=order, max_disparity=64)
    for slot in ("guidance", "guidance_at", "cost"):
        if slot in choices:
            wanted = network.config[slot]
            assert loaded.config[slot] == wanted
    left, right = torch.rand(2, 1, 3, 32, 64, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        as_trained = [images.flip(1) if order == "bgr" else images for images in (left, right)]
        expected = network(*as_trained).disparity
        torch.testing.assert_close(loaded(left, right).disparity, expected, atol=1e-3, rtol=1e-4)
        # the test could fail: the images turned around are another pair
        assert (network(*(images.flip(1) for images in as_trained)).disparity - expected).abs().max() > 0.1
