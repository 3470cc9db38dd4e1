"""A network made ready to be used on single pairs."""

import os
import time
from contextvars import ContextVar
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from stereokit.backends.eager import TorchBackend
from stereokit.backends.exported import ExportedBackend
from stereokit.backends.opening import check_backend, open_backend
from stereokit.contracts import StereoOutput
from stereokit.data.inputs import ImageLike, to_pair
from stereokit.errors import CheckpointError, ConfigError, InputError
from stereokit.inference.bounds import BoundedMatcher, TooLarge
from stereokit.inference.result import DisparityResult
from stereokit.inference.scaling import MAX_SCALE, Run, match_scaled, scaled_size
from stereokit.network import StereoNetwork, check_least_size
from stereokit.runtime.device import choose_device
from stereokit.runtime.memory import MemorySize, available_memory, running_out_as
from stereokit.weights.places import FILE_BACKENDS, check_no_program, is_exported, is_hub_id
from stereokit.weights.shipped import load_weights, named_weights, suggest_weights

__all__ = ["Predictor"]

NO_LIMITS: dict[str, Any] = {"max_memory": None, "too_large": "error"}


LARGE = 500_000


BYTES_PER_PIXEL = 25_000
"""A pair of more pixels than `LARGE`, or of more than fit at so many bytes each, has its need of memory estimated
first, which takes a second for each new size. The registered networks need less at D = 192: GC-Net the most, 22,000,
and no more than proportionally more beyond."""


# of the pair that this thread is at
_preparation_seconds: ContextVar[float] = ContextVar("preparation_seconds", default=0.0)


class Predictor:
    """A network made ready to be used on single pairs.

    Args:
        model: a network; the name of one that the library has weights for ("coex"), the name of weights
            ("coex.synthetic_v7"), the folder or hub id of a saved network, or a file that `stereokit export` wrote
            (.onnx, .xml). A network is moved to the device and put into eval mode.
        device: "auto" (a GPU if there is one and the backend can use it), or what `torch.device` takes.
        backend: "torch", "compile", "onnxruntime" or "openvino"; "auto" is that of the exported file's suffix, and
            "torch" for a network.
        precision: "float32", "bfloat16" or "float16" for the arithmetic, where the backend can; float32, or that of
            the exported file, by default.
        max_memory: bytes, or a text such as "4GiB", that matching a pair may take beside the weights; by default what
            is free on the device, looked at where a pair might need more.
        too_large: what becomes of a pair that needs more: "error" says how much and what to do, "tile" matches it
            in overlapping tiles, for which a network of one's own needs an attribute `max_disparity`, "reduce" at a
            reduced resolution; see `stereokit.inference.tiles`.
        scale: match at this part of the resolution and bring the result back, see `match_scaled`; disparities are found
            up to max_disparity / scale. 0.5 finds larger ones and less detail, 1.5 or 2 smaller ones and finer detail,
            which small images gain from, in 2 to 5 times the time.

    Raises:
        ConfigError: the device or the backend is unknown, absent, or not for this model; limits of memory for an
            exported file of one size alone; tiles of a network without `max_disparity`; or a scale that is not
            above 0 and at most 8.
        CheckpointError: there is no saved network or exported file at this place, or it can't be used.

    >>> predict = Predictor("coex", device="cpu")
    >>> left = right = np.zeros((50, 70, 3), np.uint8)
    >>> predict(left, right).disparity.shape
    (50, 70)
    """

    def __init__(
        self,
        model: nn.Module | str | os.PathLike[str],
        device: str | torch.device = "auto",
        backend: str = "auto",
        *,
        precision: str | None = None,
        max_memory: MemorySize | None = None,
        too_large: TooLarge = "error",
        scale: float = 1.0,
    ) -> None:
        if not isinstance(scale, int | float | np.floating | np.integer) or not 0 < scale <= MAX_SCALE:
            raise ConfigError(
                f"scale={scale!r} is not above 0 and at most {MAX_SCALE}; 0.5 is half the resolution, 2 double"
            )
        if not is_exported(model):
            check_backend(backend)
            device = choose_device(device)
            model = model if isinstance(model, nn.Module) else _saved_network(model)
        self.backend = open_backend(model, device, backend, precision)
        self.limits: dict[str, Any] = {"max_memory": max_memory, "too_large": too_large}
        self.scale = scale
        self._measurable = True
        self._bounded: BoundedMatcher | None = None
        self._planned: set[tuple[int, int]] = set()
        if isinstance(self.backend, TorchBackend) or self.limits != NO_LIMITS:
            self._bounded = self._matcher()

    @property
    def device(self) -> torch.device:
        """Where the backend computes."""
        return self.backend.device

    @property
    def whole(self) -> bool:
        """Whether pairs are matched as they are: at full resolution, and with no limit of memory asked for."""
        return self.scale == 1 and self.limits == NO_LIMITS

    @property
    def model(self) -> nn.Module:
        """The network.

        Raises:
            ConfigError: an exported file is run, which holds no module.
        """
        if not isinstance(self.backend, TorchBackend):
            raise ConfigError(f"backend {self.backend.name!r} runs an exported file, which holds no torch module")
        return self.backend.network

    def __call__(self, left: ImageLike, right: ImageLike) -> DisparityResult:
        """Matches one rectified pair.

        Args:
            left: path, array, tensor or PIL image, see `stereokit.data.inputs.ImageLike`; at least 32 x 32 pixels.
            right: likewise, of the same size.

        Raises:
            InputError: an image that can't be used; the message says why.
        """
        left, right = to_pair(left, right)
        check_least_size(*left.shape[-2:])
        start = time.perf_counter()
        size = scaled_size((left.shape[-2], left.shape[-1]), self.scale)
        try:
            run = self._fitting(*size)
            # what was found out for a size is kept
            _preparation_seconds.set(0.0 if size in self._planned else time.perf_counter() - start)
            self._planned.add(size)
            output = run(left, right) if self.scale == 1 else match_scaled(run, left, right, scale=self.scale)
        except InputError as error:
            if self.scale == 1:
                raise
            raise InputError(f"at scale {self.scale:g}, in pixels of the scaled pair: {error}") from error
        preparation = _preparation_seconds.get()
        seconds = time.perf_counter() - start - preparation
        confidence = None if output.confidence is None else output.confidence[0].cpu().numpy()
        return DisparityResult(output.disparity[0].cpu().numpy(), confidence, seconds, preparation)

    def _fitting(self, height: int, width: int) -> Run:
        """What matches pairs of this size within the memory, checked here if they are large."""
        if not self._measurable or (self.limits["max_memory"] is None and self._surely_fits(height * width)):
            return self._whole
        try:
            # the network of an exported file is built for the first large pair
            self._bounded = self._bounded or self._matcher()
            plan = self._bounded.plan(height, width)
        except ConfigError:
            if self.limits != NO_LIMITS:
                raise
            # nobody asked for a limit, so what can't be measured just runs
            self._measurable = False
            return self._whole
        return self._whole if plan.how == "whole" else partial(self._bounded.match, plan=plan)

    def _surely_fits(self, pixels: int) -> bool:
        if pixels > LARGE:
            return False
        if isinstance(self.backend, ExportedBackend):
            # what its runtime keeps from the pair before looks like taken
            return True
        available = available_memory(self.device)
        if available is None:
            return True
        # without it, it may be any network
        max_disparity = getattr(self.model, "max_disparity", None)
        if max_disparity is None:
            return False
        return BYTES_PER_PIXEL * max(1, max_disparity / 192) * pixels <= available

    def _matcher(self) -> BoundedMatcher:
        if isinstance(self.backend, ExportedBackend):
            network = self.backend.as_module()
            return BoundedMatcher(
                network,
                run=self._run,
                estimate=partial(self.backend.estimate_memory, network),
                device=self.device,
                **self.limits,
            )
        return BoundedMatcher(self.model, run=self._run, **self.limits)

    def _whole(self, left: Tensor, right: Tensor) -> StereoOutput:
        height, width = left.shape[-2:]
        with running_out_as(
            f"a pair of {width} x {height} pixels does not fit into the memory of {self.device}; "
            "use too_large='tile' or 'reduce' with a max_memory (--too-large, --max-memory)"
        ):
            return self._run(left, right)

    def _run(self, left: Tensor, right: Tensor) -> StereoOutput:
        """The backend; what it does once is timed apart."""
        _preparation_seconds.set(_preparation_seconds.get() + self.backend.prepare(left, right))
        disparity, confidence = self.backend(left, right)
        return StereoOutput(
            torch.from_numpy(disparity), confidence=None if confidence is None else torch.from_numpy(confidence)
        )


def _saved_network(place: str | os.PathLike[str]) -> StereoNetwork:
    if not isinstance(place, str | os.PathLike):
        raise ConfigError(f"a predictor takes a network, or the name or place of one; got {type(place).__name__}")
    name = os.fspath(place)
    check_no_program(name)
    if os.path.isfile(name):
        raise CheckpointError(
            f"{name!r} is a file; a published checkpoint is read by stereokit.load_published, and exported files end "
            f"in {' or '.join(FILE_BACKENDS)}"
        )
    if weights := named_weights(name):
        return load_weights(weights)
    if not os.path.isdir(name) and not is_hub_id(name):
        raise CheckpointError(
            f"unknown network {name!r}; {suggest_weights(name)}; or give the folder of a saved network, or an exported "
            "file"
        )
    return StereoNetwork.from_pretrained(name)
