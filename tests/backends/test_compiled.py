import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from stereokit import Predictor, build_model
from stereokit.backends.compiled import compile_cache
from stereokit.export.checking import random_pair
from stereokit.optimize.convolution import FusedConvolution
from tests.export.networks import Tiny

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")


def test_the_cache_outlives_a_run(monkeypatch):
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert compile_cache() == Path("/somewhere/stereokit/inductor")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert compile_cache() == Path.home() / ".cache/stereokit/inductor"
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/chosen")
    assert compile_cache() == Path("/chosen")


@needs_compiler
def test_one_channel_is_convolved_at_any_size():
    plain = nn.Conv3d(1, 8, 3, padding=1)
    compiled = torch.compile(FusedConvolution(plain), dynamic=True)
    with torch.inference_mode():
        for size in ((4, 6, 8), (3, 9, 5)):
            x = torch.rand(1, 1, *size)
            torch.testing.assert_close(compiled(x), plain(x))


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("network", [Tiny(), build_model("coex", max_disparity=64)])
def test_it_gives_what_the_network_gives_and_says_how_long_it_compiled(network, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    plain, compiled = Predictor(network, "cpu"), Predictor(network, "cpu", "compile")
    for size in ((64, 96), (41, 50)):
        pair = random_pair(*size)
        first, again = compiled(*pair), compiled(*pair)
        assert first.preparation_seconds > again.preparation_seconds == 0
        off = np.abs(first.disparity - plain(*pair).disparity)
        assert (off > 1e-3).mean() < 1e-3
    assert any(tmp_path.iterdir())
