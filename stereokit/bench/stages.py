"""Where the time goes: the stages of a network, as in the time table of the CoEx paper."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from types import TracebackType
from typing import Any

from torch import nn
from torch.utils.hooks import RemovableHandle

from stereokit.model import StereoModel
from stereokit.network import StereoNetwork
from stereokit.runtime.clock import Clock, synchronised_clock

__all__ = ["STAGES", "StageClock", "stages_of"]

STAGES: dict[str, str] = {
    "backbone": "feature extraction",
    "cost": "cost volume",
    "aggregation": "aggregation",
    "regression": "regression",
    "upsampler": "upsampling",
}
"""The slots of `StereoModel` and what the paper of CoEx calls them."""

REST = "rest"
"""What lies between the stages."""


def stages_of(model: StereoNetwork) -> Iterator[tuple[str, nn.Module]]:
    """The stages of a network by name, in the order in which they run; several blocks can make up one.

    >>> from stereokit import build_model
    >>> [name for name, _ in stages_of(build_model("gcnet", max_disparity=32))]
    ['feature extraction', 'cost volume', 'aggregation', 'regression', 'upsampling']
    """
    if not isinstance(model, StereoModel):
        yield from model.named_children()
        return
    yield STAGES["backbone"], model.get_submodule("backbone")
    for number, stage in enumerate(model.coarse, start=1):
        yield f"coarse stage {number}", stage
    if not model.candidates.fixed:
        yield "candidates", model.get_submodule("candidates")
    yield from ((stage, model.get_submodule(slot)) for slot, stage in STAGES.items() if slot != "backbone")
    yield from ((STAGES["cost"], cost) for cost in model.coarser_costs)
    yield from (("refinement", refinement) for refinement in model.refinements)


class StageClock:
    """Splits the passes of a network in its block into stages.

    Stages are the slots of a network made of slots, with each coarse stage as one, and all refinements as one; of any
    other network its children, by name. The clock is read before and after each, and waits for the device each time, so
    that the passes take a little longer than without it on a GPU. The regression has its confidence with it. What lies
    between them is the "rest": normalisation, padding, cropping.

    Args:
        model: runs eagerly inside the block.
        clock: waits for the device.

    >>> import torch
    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=32).eval()
    >>> with StageClock(model) as stages, torch.inference_mode():
    ...     _ = model(torch.rand(1, 3, 32, 64), torch.rand(1, 3, 32, 64))
    >>> list(stages.passes[0])
    ['feature extraction', 'cost volume', 'aggregation', 'regression', 'upsampling', 'rest']
    """

    def __init__(self, model: StereoNetwork, *, clock: Clock = synchronised_clock) -> None:
        self.model = model
        self.clock = clock
        self.passes: list[dict[str, float]] = []
        """Seconds by stage, of each pass; they sum to the whole pass."""
        self._handles: list[RemovableHandle] = []
        self._stages = list(stages_of(model))
        self._spent: dict[str, float] = {}
        self._started: dict[str, float] = {}

    def __enter__(self) -> "StageClock":
        for stage, block in self._stages:
            self._watch(block, partial(self._begin, stage), partial(self._end, stage))
            # no hook is called for what is not a forward
            if callable(method := getattr(block, "with_confidence", None)):
                block.__dict__["with_confidence"] = partial(self._timed, stage, method)
        self._watch(self.model, self._begin_pass, self._end_pass)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles.clear()
        for _, block in self._stages:
            vars(block).pop("with_confidence", None)

    def _watch(self, module: Any, begin: Callable[[], None], end: Callable[[], None]) -> None:
        assert isinstance(module, nn.Module)
        self._handles += [
            module.register_forward_pre_hook(lambda *_: begin()),
            module.register_forward_hook(lambda *_: end()),
        ]

    def _begin_pass(self) -> None:
        self._spent = defaultdict(float)
        self._begin("pass")

    def _end_pass(self) -> None:
        self._end("pass")
        whole = self._spent.pop("pass")
        stages = {stage: self._spent[stage] for stage, _ in self._stages}
        self.passes.append({**stages, REST: whole - sum(stages.values())})

    def _begin(self, stage: str) -> None:
        self._started[stage] = self.clock()

    def _end(self, stage: str) -> None:
        self._spent[stage] += self.clock() - self._started[stage]

    def _timed(self, stage: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        self._begin(stage)
        result = function(*arguments, **named)
        self._end(stage)
        return result
