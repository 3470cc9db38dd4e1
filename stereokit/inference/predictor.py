"""A network made ready to be used on single pairs."""

import copy
import hashlib
import os
import time
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Backend
from stereokit.backends.opening import check_backend, open_backend
from stereokit.cameras.rectification import Rectification, rectify
from stereokit.cameras.rig import Rig, read_rig
from stereokit.contracts import StereoOutput
from stereokit.data.bit_depth import check_bit_depth
from stereokit.data.inputs import ImageLike, to_pair
from stereokit.errors import ConfigError, InputError
from stereokit.inference.bounds import TooLarge
from stereokit.inference.distributions import Distributions, find_distributions
from stereokit.inference.planning import MemoryPlanner
from stereokit.inference.result import DisparityResult
from stereokit.inference.scaling import MAX_SCALE, match_scaled, scale_images, scaled_size
from stereokit.inference.shifting import checked_min_disparity, shift_right
from stereokit.network import check_least_size
from stereokit.runtime.device import choose_device
from stereokit.runtime.memory import MemorySize
from stereokit.runtime.provenance import state_sha256
from stereokit.weights.opening import find_network, open_network

__all__ = ["Predictor", "advice", "check_finite"]


class Predictor:
    """A network made ready to be used on single pairs.

    Args:
        model: a network, which is moved to the device and put into eval mode; or the name or place of one, see
            `open_network`: the name of a network that has weights ("coex"), the name of weights ("coex.synthetic_v7"),
            the folder or hub id of a saved network, a published checkpoint of the authors, or a file that
            `stereokit export` wrote (.onnx, .xml).
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
        rig: the cameras, or their file, where the views come as these took them: they are rectified first, see
            `rectified`, and what either camera did not see becomes NaN in the disparity. The calibration of the
            rectified pair is `predict.rectification.calibration`.
        min_disparity: the smallest disparity that is looked for, a whole number of pixels of the images as they are
            given: below 0 for cameras that are toed in and for satellites, above 0 where all is near. Disparities are
            found from there up to max_disparity / scale more.
        bit_depth: the bits of the camera, where images hold them in 16-bit or floating-point samples: 12 for values up
            to 4095.

    Raises:
        ConfigError: the device or the backend is unknown, absent, or not for this model; limits of memory for an
            exported file of one size alone; tiles of a network without `max_disparity`; a scale that is not above 0
            and at most 8; or a `min_disparity` that is no whole number.
        InputError: a bit depth that is not from 1 to 16.
        CheckpointError: there is no network at this place, or it can't be used.
        InputError: a rig that can't be read or rectified.

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
        rig: "Rig | str | os.PathLike[str] | None" = None,
        min_disparity: int = 0,
        bit_depth: int | None = None,
    ) -> None:
        if not isinstance(scale, int | float | np.floating | np.integer) or not 0 < scale <= MAX_SCALE:
            raise ConfigError(
                f"scale={scale!r} is not above 0 and at most {MAX_SCALE}; 0.5 is half the resolution, 2 double"
            )
        self.rectification: Rectification | None = None
        if rig is not None:
            self.rectification = rectify(rig if isinstance(rig, Rig) else read_rig(rig))
        self.min_disparity = checked_min_disparity(min_disparity)
        check_bit_depth(bit_depth)
        self.bit_depth = bit_depth
        self.unread = True
        check_backend(backend)
        place = None if isinstance(model, nn.Module) else find_network(model)
        if place is None or place.kind != "exported":
            # now rather than after the weights are read
            device = choose_device(device)
        opened = model if place is None else open_network(place)
        self.backend: Backend = open_backend(opened, device, backend, precision)
        self.scale = scale
        self._planner = MemoryPlanner(self.backend, max_memory, too_large)
        self._planned: set[tuple[int, int]] = set()

    @property
    def limits(self) -> dict[str, Any]:
        """The limits of memory as they were given: `max_memory` and `too_large`."""
        return self._planner.limits

    @property
    def device(self) -> torch.device:
        """Where the backend computes."""
        return self.backend.device

    @property
    def whole(self) -> bool:
        """Whether pairs are matched as they are: at full resolution, and with no limit of memory asked for."""
        return self.scale == 1 and not self._planner.limited

    @property
    def model(self) -> nn.Module:
        """The network.

        Raises:
            ConfigError: an exported file is run, which holds no module.
        """
        if not isinstance(self.backend, TorchBackend):
            raise ConfigError(f"backend {self.backend.name!r} runs an exported file, which holds no torch module")
        return self.backend.network

    def describe(self) -> dict[str, Any]:
        """The network's configuration and the hash of its weights, and what runs it and how, in plain JSON."""
        parts: dict[str, Any] = {
            "device": str(self.device),
            "backend": self.backend.name,
            "precision": self.backend.precision,
            **self.backend.describe(),
        }
        if not self.whole:
            parts["limits"] = {"scale": self.scale, **self.limits}
        if self.min_disparity:
            parts["min_disparity"] = self.min_disparity
        if self.bit_depth is not None:
            parts["bit_depth"] = self.bit_depth
        if self.rectification is not None:
            digest = hashlib.sha256()
            for view in (self.rectification.left_map, self.rectification.right_map):
                for axis in view:
                    digest.update(np.ascontiguousarray(axis).tobytes())
            parts["rectification_sha256"] = digest.hexdigest()
        if isinstance(self.backend, TorchBackend):
            parts["weights_sha256"] = state_sha256(self.backend.network.state_dict())
        return parts

    def __call__(self, left: ImageLike, right: ImageLike) -> DisparityResult:
        """Matches one pair, rectified or, with a rig, as its cameras took it.

        Args:
            left: path, array, tensor or PIL image, see `stereokit.data.inputs.ImageLike`; at least 32 x 32 pixels.
            right: likewise, of the same size.

        Raises:
            InputError: an image that can't be used, views of another size than the rig's, or a network that gives
                nothing finite; the message says why.
        """
        result = self._match(*self.rectified(left, right))
        if self.rectification is None:
            return result
        return result.masked(self.rectification.seen(result.disparity))

    def for_read_views(self) -> "Predictor":
        """The same, for views that `to_pair` has read already by the bit depth, so that it is not applied again."""
        other = copy.copy(self)
        other.bit_depth = None
        other.unread = False
        return other

    def rectified(self, left: ImageLike, right: ImageLike) -> tuple[Tensor, Tensor]:
        """The pair that is matched, two (1, 3, H, W): rectified where there is a rig, else as it is.

        Raises:
            InputError: see `__call__`.
        """
        pair = to_pair(left, right, bit_depth=self.bit_depth, doubt=self.unread)
        if self.rectification is None:
            return pair
        first, second = self.rectification(*(view[0].permute(1, 2, 0).numpy() for view in pair))
        return to_pair(first, second, doubt=False)

    def match(self, left: ImageLike, right: ImageLike) -> DisparityResult:
        """Matches one pair that is rectified, whether there is a rig or not.

        Raises:
            InputError: see `__call__`.
        """
        return self._match(*to_pair(left, right, bit_depth=self.bit_depth, doubt=self.unread))

    def _match(self, left: Tensor, right: Tensor) -> DisparityResult:
        check_least_size(*left.shape[-2:])
        right = shift_right(right, self.min_disparity)
        start = time.perf_counter()
        run = _TimedBackend(self.backend)
        size = scaled_size((left.shape[-2], left.shape[-1]), self.scale)
        try:
            plan = self._planner.plan(*size)
            # what was found out for a size is kept
            planning = 0.0 if size in self._planned else time.perf_counter() - start
            self._planned.add(size)
            match = partial(self._planner.match, plan=plan, run=run)
            output = match(left, right) if self.scale == 1 else match_scaled(match, left, right, scale=self.scale)
        except InputError as error:
            if self.scale == 1:
                raise
            raise InputError(f"at scale {self.scale:g}, in pixels of the scaled pair: {error}") from error
        preparation = planning + run.preparation_seconds
        seconds = time.perf_counter() - start - preparation
        confidence = None if output.confidence is None else output.confidence[0].cpu().numpy()
        disparity = output.disparity[0].cpu().numpy() + self.min_disparity
        check_finite(disparity, self.backend)
        return DisparityResult(disparity, confidence, seconds, preparation)

    def distributions(self, left: ImageLike, right: ImageLike) -> Distributions:
        """What the network says about all candidates of a pair that is rectified, from which the disparity comes.

        The pair is matched once more, by PyTorch in single precision.

        Args:
            left: as for a call.
            right: likewise.

        Raises:
            InputError: an image that can't be used, or a pair that does not fit into the memory as a whole.
            ConfigError: the network has no distribution, an exported file is run, or `min_disparity` is not 0.

        >>> predict = Predictor("coex", device="cpu")
        >>> found = predict.distributions(*np.zeros((2, 50, 70, 3), np.uint8)).at([20], [30])
        >>> int(found.kept.sum())
        2
        """
        network = self.model
        if self.min_disparity:
            raise ConfigError(
                f"distributions begin at disparity 0, and min_disparity is {self.min_disparity}; leave it out"
            )
        left, right = to_pair(left, right, bit_depth=self.bit_depth, doubt=self.unread)
        given = (left.shape[-2], left.shape[-1])
        check_least_size(*given)
        size = scaled_size(given, self.scale)
        plan = self._planner.plan(*size)
        if plan.how != "whole":
            raise InputError(
                f"a pair of {given[1]} x {given[0]} pixels does not fit into the memory as a whole, so there is no "
                "distribution of all of it; use a smaller scale"
            )
        views = [view.to(self.device) for view in (left, right)]
        if self.scale != 1:
            views = [scale_images(view, size) for view in views]
        return find_distributions(network, views[0], views[1], size=given)


def check_finite(disparity: npt.NDArray[Any], backend: Backend) -> None:
    """Refuses what a network made of a pair where no pixel of it is finite.

    Raises:
        InputError: it is so; the message names the precision, which is mostly what did it.
    """
    if not np.isfinite(disparity).any():
        raise InputError(
            f"the network gave no finite disparity at any pixel, {advice(backend.precision, str(backend.device))}"
        )


def advice(precision: str, device: str) -> str:
    """What to do about disparities that are not finite."""
    if precision == "float16":
        return (
            f"in float16 on {device}, whose numbers end at 65504: use precision 'bfloat16' or 'float32' (--precision)"
        )
    return f"in {precision} on {device}: its weights or its arithmetic hold NaN or infinity"


class _TimedBackend:
    """A backend for the images of one pair, which may be several tiles; what it does once is timed apart."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.preparation_seconds = 0.0

    def __call__(self, left: Tensor, right: Tensor) -> StereoOutput:
        self.preparation_seconds += self.backend.prepare(left, right)
        disparity, confidence = self.backend(left, right)
        return StereoOutput(
            torch.from_numpy(disparity), confidence=None if confidence is None else torch.from_numpy(confidence)
        )
