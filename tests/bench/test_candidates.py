import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from stereokit import CheckpointError, ConfigError, Predictor, build_model, list_weights, load_weights
from stereokit.bench.candidates import Candidate, image_pair, rival_source, source_of

CPU = torch.device("cpu")


def test_a_network_by_name_or_from_a_folder(tmp_path: Path) -> None:
    model = build_model("coex", max_disparity=64)
    model.save_pretrained(tmp_path)
    saved = source_of(str(tmp_path))
    assert torch.equal(saved().mean, model.mean)
    assert torch.equal(next(saved().parameters()), next(model.parameters()))
    assert saved(max_disparity=32).max_disparity == 32
    assert torch.equal(next(saved(max_disparity=32).parameters()), next(model.parameters()))
    assert source_of("psmnet")(max_disparity=64).config["name"] == "psmnet"
    for name in list_weights():
        made, shipped = source_of(name)(max_disparity=64), load_weights(name)
        assert made.max_disparity == 64
        assert torch.equal(next(made.parameters()), next(shipped.parameters()))
    with pytest.raises(CheckpointError, match=r"did you mean 'coex'"):
        source_of("coexx")
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match=r"file"):
        source_of(str(tmp_path / "file"))()


def test_a_published_checkpoint_tells_its_network(tmp_path: Path) -> None:
    from tests.golden import published_state, save_checkpoint
    from tests.shared import SHARED

    if not SHARED.is_dir():
        pytest.skip("the shared sample data is not here")
    path = save_checkpoint(published_state("psmnet_corr"), tmp_path / "published.ckpt")
    assert source_of(str(path))(max_disparity=64).config["name"] == "psmnet"


def test_random_weights_are_the_same_each_time_and_the_generator_is_left_alone() -> None:
    candidate = Candidate("coex", source_of("coex"), max_disparity=64)
    before = torch.get_rng_state()
    first, second = candidate.build(), candidate.build()
    assert torch.equal(before, torch.get_rng_state())
    assert not first.training
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_the_eager_network_is_the_network_in_its_precision() -> None:
    candidate = Candidate("coex", source_of("coex"), "eager", height=32, width=64, max_disparity=32)
    images = image_pair(candidate, CPU)
    network = candidate.build()
    with torch.inference_mode():
        expected = network(*images).disparity
        assert torch.equal(candidate.ready(candidate.build(), CPU)(*images).disparity, expected)
        half = Candidate(**{**vars(candidate), "precision": "bfloat16"})
        ready = half.ready(half.build(), CPU)
    assert {p.dtype for p in ready.parameters()} == {torch.bfloat16}


def test_torch_is_what_a_predictor_runs() -> None:
    candidate = Candidate("coex", source_of("coex"), "torch", height=32, width=64, max_disparity=32)
    images = image_pair(candidate, CPU)
    with torch.inference_mode():
        disparity = candidate.ready(candidate.build(), CPU)(*images).disparity
    assert np.array_equal(Predictor(candidate.build(), CPU)(*images).disparity, disparity[0].numpy())


def test_what_is_unknown_is_refused() -> None:
    for wrong, hint in (
        ({"backend": "eagre"}, "did you mean 'eager'"),
        ({"precision": "float31"}, "'float31' is unknown; use float32, bfloat16, float16"),
    ):
        candidate = Candidate("coex", source_of("coex"), max_disparity=64, **wrong)
        with pytest.raises(ConfigError, match=hint):
            candidate.ready(candidate.build(), CPU)
    with pytest.raises(ConfigError, match=r"did you mean 'sgbm'"):
        rival_source("sgmb")


def test_a_rival_matches_every_pair_of_the_batch() -> None:
    place = {"height": 40, "width": 120, "batch": 2, "max_disparity": 32}
    candidate = Candidate("sgbm", rival_source("sgbm"), "opencv", "uint8", **place)
    images = image_pair(candidate, CPU)
    disparities = candidate.ready(candidate.build(), CPU)(*images)
    assert len(disparities) == 2
    # the texture was moved by a quarter of D
    assert [float(np.median(disparity)) for disparity in disparities] == [8, 8]


def test_candidates_travel_to_other_processes() -> None:
    for source in (source_of("coex"), rival_source("sgbm")):
        candidate = Candidate("x", source, max_disparity=64)
        assert type(pickle.loads(pickle.dumps(candidate)).build()) is type(candidate.build())
