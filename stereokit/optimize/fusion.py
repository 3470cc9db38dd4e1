"""Finds convolutions that a batch norm and an activation follow, in any network, by watching one forward pass."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from stereokit.optimize.convolution import (
    Activation,
    FusedConvolution,
    fusable_activation,
    is_plain_convolution,
)

__all__ = ["Chain", "find_chains", "fuse"]


@dataclass
class Chain:
    """A convolution and what can be done in one with it.

    Args:
        conv: the path of the convolution.
        norm: the path of the batch norm that alone reads its output; None for none.
        activation: the path of the activation that alone reads that; None for none, or for one inside of the norm.
    """

    conv: str
    norm: str | None = None
    activation: str | None = None


@dataclass
class Call:
    """One call of a module: what it read and gave, and the first operation inside it and the first one after it."""

    path: str
    inputs: tuple[Any, ...]
    output: Any
    first: int
    end: int


@dataclass
class Recording:
    """The calls of one forward pass in order, and which operations read each tensor, by its id."""

    calls: list[Call] = field(default_factory=list)
    readers: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    results: set[int] = field(default_factory=set)
    # ids are unique only as long as the tensors live
    alive: list[Any] = field(default_factory=list)
    operations: int = 0


class Recorder(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Numbers the operations of a forward pass and notes what each of them reads."""

    def __init__(self, recording: Recording) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.recording = recording

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs the operation and notes it."""
        recording = self.recording
        for tensor in tree_leaves((args, kwargs)):
            if isinstance(tensor, Tensor):
                recording.readers[id(tensor)].append(recording.operations)
                recording.alive.append(tensor)
        recording.operations += 1
        output = func(*args, **(kwargs or {}))
        recording.alive.append(output)
        return output


def find_chains(model: nn.Module, run: Callable[[nn.Module], Any]) -> list[Chain]:
    """The convolutions that a forward pass calls, each with the norm and the activation that alone read its output.

    Nothing is taken for granted about the network: a convolution whose output goes elsewhere too, that is called in
    two ways, that is a subclass, has hooks or is never called, is left out or left without what follows it.

    Args:
        model: in eval mode.
        run: calls the network once.
    """
    recording = record(model, run)
    modules = dict(model.named_modules())
    calls = defaultdict(list)
    for call in recording.calls:
        calls[call.path].append(call)
    readers = defaultdict(list)
    for call in sorted(recording.calls, key=lambda call: call.first):
        readers[id(call.inputs[0])].append(call)

    def follower(path: str, suits: Callable[[nn.Module], bool]) -> str | None:
        """The module that reads the output of each call before anything else does, if it reads nothing else."""
        pairs = []
        for call in calls[path]:
            reader = next((r for r in readers[id(call.output)] if r.first >= call.end), None)
            if reader is None or not alone(call, reader):
                return None
            pairs.append(reader)
        paths = {reader.path for reader in pairs}
        next_path = paths.pop()
        if paths or len(calls[next_path]) != len(pairs) or not suits(modules[next_path]) or not private(next_path):
            return None
        return next_path

    def private(path: str) -> bool:
        """Whether only the module itself reads its weights."""
        own = [range(call.first, call.end) for call in calls[path]]
        tensors = (*modules[path].parameters(), *modules[path].buffers())
        return all(any(i in span for span in own) for t in tensors for i in recording.readers[id(t)])

    def alone(call: Call, reader: Call) -> bool:
        """Whether nothing but the reader sees what a call gave."""
        others = [i for i in recording.readers[id(call.output)] if i >= call.end and not reader.first <= i < reader.end]
        if reader.output is call.output:
            # written in place: those that come later read the result
            return all(i >= reader.end for i in others)
        return not others and id(call.output) not in recording.results

    chains = []
    for path in list(calls):
        if not is_plain_convolution(modules[path]) or not private(path):
            continue
        chain = Chain(path)
        chain.norm = follower(path, is_plain_norm)
        last = chain.norm or path
        if chain.norm is None or inner_activation(modules[chain.norm]) is None:
            chain.activation = follower(last, lambda module: fusable_activation(module) is not None)
        chains.append(chain)
    return chains


def fuse(model: nn.Module, chains: Sequence[Chain]) -> None:
    """Makes each convolution a `FusedConvolution`, and what follows it an identity.

    They change in place: a network may call them by another way than by their names, from a list of its own say.
    """
    modules = dict(model.named_modules())
    replaced: dict[nn.Module, nn.Module] = {}
    for chain in chains:
        conv: Any = modules[chain.conv]
        norm: Any = None if chain.norm is None else modules[chain.norm]
        after = None if chain.activation is None else modules[chain.activation]
        if norm is not None:
            inner = inner_activation(norm)
            rest: nn.Module = nn.Identity()
            if inner is not None and fusable_activation(inner) is None:
                rest = inner
            elif inner is not None:
                after = inner
            replaced[norm] = rest
        if chain.activation is not None:
            replaced[modules[chain.activation]] = nn.Identity()
        activation: Activation | None = None if after is None else fusable_activation(after)
        replaced[conv] = FusedConvolution(conv, norm, activation).eval()
    for module, other in replaced.items():
        module.__class__ = type(other)
        module.__dict__ = other.__dict__


def is_plain_norm(module: nn.Module) -> bool:
    """Whether a module is a batch norm with running statistics as it comes, alone or with timm's activation in it."""
    plain = type(module) in (nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm) or is_norm_with_activation(module)
    return plain and module.running_mean is not None and module.running_var is not None


def is_norm_with_activation(module: nn.Module) -> bool:
    """Whether a module is timm's batch norm that applies an activation itself."""
    kind = type(module)
    # timm takes a second to import, and where it is not imported the network has none
    return (
        kind.__name__ == "BatchNormAct2d"
        and kind.__module__.startswith("timm.")
        and isinstance(module.drop, nn.Identity)
    )


def inner_activation(norm: nn.Module) -> nn.Module | None:
    """The activation that a norm applies itself."""
    if not is_norm_with_activation(norm):
        return None
    activation = norm.act
    assert isinstance(activation, nn.Module)
    return activation


def record(model: nn.Module, run: Callable[[nn.Module], Any]) -> Recording:
    """One forward pass: the calls of convolutions, norms and activations without hooks, and all operations."""
    recording = Recording()
    starts: dict[nn.Module, int] = {}
    paths = {}
    for path, module in model.named_modules():
        activation = fusable_activation(module) is not None and type(module) is not nn.Identity
        if (is_plain_convolution(module) or is_plain_norm(module) or activation) and not has_hooks(module):
            paths[module] = path

    def before(module: nn.Module, args: tuple[Any, ...]) -> None:
        starts[module] = recording.operations

    def after(module: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any], output: Any) -> None:
        inputs = (*args, *kwargs.values())
        recording.alive.append((inputs, output))
        recording.calls.append(Call(paths[module], inputs, output, starts[module], recording.operations))

    with ExitStack() as stack:
        for module in paths:
            for handle in (
                module.register_forward_pre_hook(before),
                module.register_forward_hook(after, with_kwargs=True),
            ):
                stack.callback(handle.remove)
        stack.enter_context(torch.no_grad())
        stack.enter_context(Recorder(recording))
        output = run(model)
    recording.results = {id(leaf) for leaf in tree_leaves(output)}
    recording.alive.append(output)
    # a call with more than one argument, such as the size of a transposed convolution's output, stays as it is
    odd = {call.path for call in recording.calls if len(call.inputs) != 1}
    recording.calls = [call for call in recording.calls if call.path not in odd]
    return recording


def has_hooks(module: nn.Module) -> bool:
    """Whether calling a module does more than its forward."""
    return any(
        getattr(module, name)
        for name in ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
    )
