"""A network as a graph: what every format of export starts from."""

import contextlib
import io
import logging
import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
import torch.fx.experimental._config
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from stereokit.errors import ConfigError, InputError
from stereokit.network import check_least_size, least_size_of

__all__ = ["ExportGraph", "example_size", "naming_block", "trace"]

Size = tuple[int, int]


class ExportGraph(nn.Module):
    """What is exported: left and right (1, 3, H, W), float32 in [0, 1], to disparity and confidence (1, H, W).

    A network that gives no confidence has the disparity alone. Normalisation and padding are those of the network.

    Args:
        network: any module with `forward(left, right) -> StereoOutput`.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, ...]:
        """A pair to its maps."""
        output = self.network(left, right)
        return (output.disparity,) if output.confidence is None else (output.disparity, output.confidence)


def trace(model: nn.Module, size: Size | None) -> ExportedProgram:
    """The graph of a network in eval mode, on the CPU.

    Args:
        model: any module with `forward(left, right) -> StereoOutput`, in eval mode.
        size: height and width of the images; None for any from 32 x 32 up.

    Raises:
        ConfigError: the network holds what can't be exported; the block that does is named.
        InputError: a size below 32 x 32.

    >>> from stereokit import build_model
    >>> program = trace(build_model("coex", max_disparity=64).eval(), (64, 96))
    >>> [tuple(x.shape) for x in program.module()(torch.rand(1, 3, 64, 96), torch.rand(1, 3, 64, 96))]
    [(1, 64, 96), (1, 64, 96)]
    """
    if size is not None:
        check_least_size(*size, least_size_of(model))
    graph = ExportGraph(model)
    height, width = size or example_size(model)
    images = (torch.rand(1, 3, height, width), torch.rand(1, 3, height, width))
    axes = None if size else {2: Dim("height", min=least_size_of(model)), 3: Dim("width", min=least_size_of(model))}
    with naming_block(graph), torch.no_grad(), _sizes_as_unknowns():
        # sizes that the solver can't prove to fit are checked when the program runs, not settled on the example's
        return torch.export.export(
            graph,
            images,
            dynamic_shapes={"left": axes, "right": axes},
            prefer_deferred_runtime_asserts_over_guards=True,
        )


def _sizes_as_unknowns() -> AbstractContextManager[None]:
    """Keeps the tracer from branching on what holds for the example's size, as PyTorch's own ONNX exporter does."""
    settings: Any = torch.fx.experimental._config
    patched: AbstractContextManager[None] = settings.patch(backed_size_oblivious=True)
    return patched


def example_size(model: nn.Module) -> Size:
    """A size that stands for any: unlike sides, neither of them a multiple of what the network pads to, nor small.

    >>> example_size(nn.Identity())
    (91, 157)
    """
    multiple = max(int(getattr(model, "multiple", 1)), least_size_of(model))
    return 3 * multiple - 5, 5 * multiple - 3


@contextmanager
def naming_block(graph: nn.Module) -> Iterator[None]:
    """Turns what goes wrong inside into a `ConfigError` of one line that names the block of the network.

    Args:
        graph: the module that is traced or converted inside.
    """
    logging_was = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        # torch prints the whole graph when it fails
        with contextlib.redirect_stderr(io.StringIO()):
            yield
    except (ConfigError, InputError):
        raise
    except Exception as error:
        block = _find_block(graph, error)
        where = f"the block {block} of the network" if block else "the network"
        raise ConfigError(f"{where} can't be exported: {_reason(error)}") from error
    finally:
        logging.disable(logging_was)


def _find_block(graph: nn.Module, error: BaseException) -> str | None:
    """The path of the innermost module whose forward was running, or whose operator was being converted."""
    paths = {id(module): path for path, module in graph.named_modules()}
    for link in reversed(_chain(error)):
        for frame, _ in reversed(list(traceback.walk_tb(link.__traceback__))):
            found = [paths.get(id(frame.f_locals.get("self")))]
            for value in frame.f_locals.values():
                if isinstance(value, torch.fx.Node):
                    # as _export_root.network.backbone
                    stack = list(value.meta.get("nn_module_stack", {}).values())
                    found += [stack[-1][0]] if stack else []
            for path in filter(None, found):
                _, network, inside = path.rpartition("network.")
                if network:
                    return inside
    return None


def _reason(error: BaseException) -> str:
    """The first line of what went wrong at the bottom."""
    lines = [line.strip() for line in str(_chain(error)[-1]).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _chain(error: BaseException) -> list[BaseException]:
    chain = [error]
    while (cause := chain[-1].__cause__) is not None and cause not in chain:
        chain.append(cause)
    return chain
