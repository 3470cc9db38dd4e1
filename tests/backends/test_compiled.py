import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch._dynamo.exc import BackendCompilerFailed

from stereokit import ConfigError, Predictor, build_model
from stereokit.backends.compiled import CompiledBackend, compile_cache
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


@pytest.mark.parametrize("error", [BackendCompilerFailed(print, OSError("no g++"), None), PermissionError("no cache")])
def test_where_it_can_not_compile_it_is_one_line(error, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr(CompiledBackend, "make_ready", lambda self, network: fail)
    with pytest.raises(ConfigError, match=r"can't compile here \(.*no .*C\+\+ compiler.*use backend 'torch'"):
        Predictor(Tiny(), "cpu", "compile")(*random_pair(64, 96))


@pytest.mark.slow
def test_kinds_of_sizes_do_not_end_in_uncompiled_runs(monkeypatch):
    compiled = []

    def count(graph, _):
        compiled.append(graph)
        return graph.forward

    monkeypatch.setattr(CompiledBackend, "make_ready", lambda self, network: torch.compile(network, backend=count))
    predict = Predictor(build_model("coex", max_disparity=64), "cpu", "compile")
    for size in ((64, 96), (64, 128), (96, 128), (61, 128), (96, 96), (61, 96), (64, 64), (70, 70)):
        for dtype in (np.uint8, np.float32):
            predict(*np.zeros((2, *size, 3), dtype))
    assert len(compiled) <= 8
    assert torch._dynamo.config.recompile_limit == 8


@needs_compiler
@pytest.mark.slow
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
