"""How a backend matches pairs within the memory there is."""

from functools import partial
from typing import Any

from torch import Tensor

from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Backend
from stereokit.backends.exported import ExportedBackend
from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError
from stereokit.inference.bounds import BoundedMatcher, MemoryPlan, TooLarge
from stereokit.inference.scaling import Run
from stereokit.runtime.memory import MemorySize, available_memory, running_out_as

__all__ = ["MemoryPlanner"]

LARGE = 500_000


BYTES_PER_PIXEL = 25_000
"""A pair of more pixels than `LARGE`, or of more than fit at so many bytes each, has its need of memory estimated
first, which takes a second for each new size. The registered networks need less at D = 192: GC-Net the most, 22,000,
and no more than proportionally more beyond."""


class MemoryPlanner:
    """Plans pairs for a backend, and matches them as planned. What a size needs is found out once and kept.

    Args:
        backend: what matches.
        max_memory: see `BoundedMatcher`; without a limit, small pairs are not looked at.
        too_large: see `BoundedMatcher`.

    Raises:
        ConfigError: limits that are not known, or not for this network, see `BoundedMatcher`.

    >>> import torch
    >>> from stereokit import build_model
    >>> backend = TorchBackend(build_model("coex", max_disparity=64), torch.device("cpu"))
    >>> MemoryPlanner(backend, "100MB", "tile").plan(400, 600).how
    'tile'
    """

    def __init__(self, backend: Backend, max_memory: MemorySize | None = None, too_large: TooLarge = "error") -> None:
        self.backend = backend
        self.limits: dict[str, Any] = {"max_memory": max_memory, "too_large": too_large}
        self._measurable = True
        self._bounded: BoundedMatcher | None = None
        if self.limited or isinstance(backend, TorchBackend):
            self._bounded = self._matcher()

    @property
    def limited(self) -> bool:
        """Whether a limit was asked for."""
        return self.limits != {"max_memory": None, "too_large": "error"}

    def plan(self, height: int, width: int) -> MemoryPlan:
        """How pairs of this size are matched.

        Raises:
            InputError: they do not fit, and are not to be cut or reduced, or can't be.
            ConfigError: a limit was asked for, and the need of this network can't be found out.
        """
        unchecked = MemoryPlan("whole", needed=None, allowed=None)
        if not self._measurable or (self.limits["max_memory"] is None and self._surely_fits(height * width)):
            return unchecked
        try:
            # the network of an exported file is built for the first large pair
            self._bounded = self._bounded or self._matcher()
            return self._bounded.plan(height, width)
        except ConfigError:
            if self.limited:
                raise
            # nobody asked for a limit, so what can't be measured just runs
            self._measurable = False
            return unchecked

    def match(self, left: Tensor, right: Tensor, *, plan: MemoryPlan, run: Run) -> StereoOutput:
        """Matches a pair (1, 3, H, W) as planned.

        Args:
            left: of the size that was planned.
            right: likewise.
            plan: from `plan`.
            run: matches what fits: the whole pair, its tiles, or the reduced pair.

        Raises:
            InputError: the memory runs out.
        """
        if plan.how != "whole" and self._bounded is not None:
            return self._bounded.match(left, right, plan, run=run)
        height, width = left.shape[-2:]
        with running_out_as(
            f"a pair of {width} x {height} pixels does not fit into the memory of {self.backend.device}; "
            "use too_large='tile' or 'reduce' with a max_memory (--too-large, --max-memory)"
        ):
            return run(left, right)

    def _surely_fits(self, pixels: int) -> bool:
        if pixels > LARGE:
            return False
        if not isinstance(self.backend, TorchBackend):
            # what the runtime of an exported file keeps from the pair before looks like taken
            return True
        available = available_memory(self.backend.device)
        if available is None:
            return True
        # without it, it may be any network
        max_disparity = getattr(self.backend.network, "max_disparity", None)
        if max_disparity is None:
            return False
        return BYTES_PER_PIXEL * max(1, max_disparity / 192) * pixels <= available

    def _matcher(self) -> BoundedMatcher:
        if isinstance(self.backend, ExportedBackend):
            network = self.backend.as_module()
            estimate = partial(self.backend.estimate_memory, network)
            return BoundedMatcher(network, estimate=estimate, device=self.backend.device, **self.limits)
        assert isinstance(self.backend, TorchBackend)
        return BoundedMatcher(self.backend.network, **self.limits)
