"""What can be timed: a network on a backend in a precision at a size, or a classical rival."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from stereokit.backends import open_backend
from stereokit.backends.compiled import compile_network, room_for_versions
from stereokit.errors import ConfigError
from stereokit.evaluation.sgbm import SGBM_VARIANTS
from stereokit.export import export_onnx, export_openvino
from stereokit.export.calibration import SYNTHETIC, find_pairs
from stereokit.optimize import prepare_for_inference
from stereokit.registry import suggest
from stereokit.runtime.precision import DTYPES, dtype_of
from stereokit.weights.opening import find_network, load_network, set_iterations
from stereokit.weights.places import FILE_BACKENDS

__all__ = ["BACKENDS", "PRECISIONS", "Candidate", "Ready", "Source", "image_pair", "rival_source", "source_of"]

Source: TypeAlias = Callable[..., Any]
"""Makes a network, or a matcher such as SGBM; takes ``max_disparity``, or nothing for its own."""

Ready: TypeAlias = Callable[[Tensor, Tensor], object]
"""Matches images (B, 3, H, W), uint8, that lie on the device."""


PRECISIONS = (*DTYPES, "int8")
"""int8 for OpenVINO alone."""

CALIBRATION_PAIRS = 2


@dataclass(frozen=True)
class Candidate:
    """One row of a benchmark.

    Args:
        name: what the table calls it.
        source: makes the network; see `source_of`.
        backend: what runs it, one of `BACKENDS`.
        precision: that it computes in.
        height, width: of the images.
        batch: pairs at once.
        max_disparity: D, in pixels; None for the network's own.
        iterations: of a recurrent network; None for the network's own.
    """

    name: str
    source: Source
    backend: str = "torch"
    precision: str = "float32"
    height: int = 384
    width: int = 1248
    batch: int = 1
    max_disparity: int | None = None
    iterations: int | None = None

    def build(self) -> Any:
        """The network, or the matcher; its random weights are the same each time.

        Raises:
            StereoKitError: it can't be made.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            made = self.source() if self.max_disparity is None else self.source(max_disparity=self.max_disparity)
        if self.iterations is not None:
            set_iterations(made, self.iterations)
        return made.eval() if isinstance(made, nn.Module) else made

    def export(self, folder: str) -> Path | None:
        """Writes the file that the backend runs, where it runs one.

        Raises:
            ConfigError: the backend's files can't be had, or not for this candidate.
        """
        return EXPORTS[self.backend](self, folder) if self.backend in EXPORTS else None

    def ready(self, made: Any, device: torch.device) -> Ready:
        """What runs, from what `build` or `export` made.

        Raises:
            ConfigError: the backend or the precision is unknown, or not to be had here.
        """
        if self.backend not in BACKENDS:
            raise ConfigError(f"unknown backend {self.backend!r}; {suggest(self.backend, list(BACKENDS))}")
        return BACKENDS[self.backend](made, self, device)


def eager(network: nn.Module, candidate: Candidate, device: torch.device) -> Ready:
    """The network as it was written, in the types that were asked for."""
    ready: Ready = network.to(device, dtype_of(candidate.precision))
    return ready


def prepared(network: nn.Module, candidate: Candidate, device: torch.device) -> Ready:
    """The network made ready for inference, operation by operation: what `Predictor` runs."""
    ready: Ready = prepare_for_inference(network.to(device), precision=candidate.precision)
    return ready


def compiled(network: nn.Module, candidate: Candidate, device: torch.device) -> Ready:
    """What `Predictor` runs, compiled for the one size and as one graph: it fails where it can't be."""
    fast = prepare_for_inference(network.to(device), precision=candidate.precision)
    ready: Ready = compile_network(fast, device, dynamic=False, fullgraph=True)
    # networks share the code of their class; past the limit of versions of it, one would fail
    with room_for_versions(), torch.inference_mode():
        ready(*image_pair(candidate, device))
    return ready


def exported(path: Path, candidate: Candidate, device: torch.device) -> Ready:
    """An exported file in the runtime that reads it."""
    backend = open_backend(path, device)
    if backend.precision != candidate.precision:
        raise ConfigError(f"{candidate.backend} computes in {backend.precision} here, not in {candidate.precision}")
    return backend


def _to_onnx(candidate: Candidate, folder: str) -> Path:
    _check_batch(candidate)
    if candidate.precision != "float32":
        raise ConfigError(f"ONNX files compute in float32; got {candidate.precision}")
    return export_onnx(candidate.build(), f"{folder}/network.onnx", size=(candidate.height, candidate.width)).path


def _to_openvino(candidate: Candidate, folder: str) -> Path:
    _check_batch(candidate)
    network, size = candidate.build(), (candidate.height, candidate.width)
    calibration = None
    if candidate.precision == "int8":
        # what is measured decides on errors, not on the speed
        calibration = list(find_pairs([SYNTHETIC], CALIBRATION_PAIRS, network, size).values())
    return export_openvino(
        network, f"{folder}/network.xml", size=size, precision=candidate.precision, calibration=calibration
    ).path


def _check_batch(candidate: Candidate) -> None:
    if candidate.batch != 1:
        raise ConfigError(f"exported files take one pair at a time; got a batch of {candidate.batch}")


def opencv(matcher: Any, candidate: Candidate, device: torch.device) -> Ready:
    """A matcher of images in memory, one pair after the other."""

    def match(left: Tensor, right: Tensor) -> object:
        views = (images.permute(0, 2, 3, 1).contiguous().cpu().numpy() for images in (left, right))
        return [matcher(*pair) for pair in zip(*views, strict=True)]

    return match


BACKENDS: Mapping[str, Callable[[Any, Candidate, torch.device], Ready]] = {
    "torch": prepared,
    "eager": eager,
    "compile": compiled,
    "onnxruntime": exported,
    "openvino": exported,
    "opencv": opencv,
}
"""What runs a candidate: a function from what its source made, itself and the device to what is timed. To know a
further backend takes a further entry; one that is not installed raises `ConfigError` here, and its row says so."""

EXPORTS: Mapping[str, Callable[[Candidate, str], Path]] = {"onnxruntime": _to_onnx, "openvino": _to_openvino}
"""What writes the file, for the one size, that a backend runs in place of the network."""


def source_of(model: str) -> Source:
    """The source of a network, by its name or place, see `stereokit.open_network`.

    Weights do not change the speed: a network given by its name has random ones.

    Raises:
        CheckpointError: there is no such network, or it is an exported file.

    >>> source_of("coex")(max_disparity=64).max_disparity
    64
    """
    place = find_network(model, bare_name="untrained")
    backend = FILE_BACKENDS.get(Path(model).suffix.lower())
    place.check_module(f"stereokit bench NETWORK --backend {backend}, which exports the network and times the file")
    return partial(load_network, place)


def rival_source(name: str) -> Source:
    """The source of a classical matcher, see `stereokit.evaluation.SGBM_VARIANTS`.

    Raises:
        ConfigError: there is none of this name.

    >>> rival_source("sgbm")(max_disparity=64).search_range
    64
    """
    if name not in SGBM_VARIANTS:
        raise ConfigError(f"unknown rival {name!r}; {suggest(name, list(SGBM_VARIANTS))}")
    return partial(_rival, name)


def _rival(name: str, max_disparity: int | None = None) -> Any:
    variant = SGBM_VARIANTS[name]
    return variant if max_disparity is None else replace(variant, search_range=max_disparity)


def image_pair(candidate: Candidate, device: torch.device) -> tuple[Tensor, Tensor]:
    """A pair to match, (B, 3, H, W), uint8: a random texture, and the same moved by a quarter of D (48 px by default).

    >>> left, right = image_pair(Candidate("x", dict, height=40, width=60, batch=2), torch.device("cpu"))
    >>> left.shape, torch.equal(left, right)
    (torch.Size([2, 3, 40, 60]), False)
    """
    generator = torch.Generator().manual_seed(0)
    shape = (candidate.batch, 3, -(-candidate.height // 4), -(-candidate.width // 4))
    coarse = torch.rand(shape, generator=generator)
    left = nn.functional.interpolate(coarse, scale_factor=4, mode="bilinear")
    left = (left[..., : candidate.height, : candidate.width] * 255).to(torch.uint8).contiguous()
    right = left.roll(-((candidate.max_disparity or 192) // 4), dims=-1)
    return left.to(device), right.to(device)
