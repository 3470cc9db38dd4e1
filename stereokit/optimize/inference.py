"""A copy of a network, made ready for inference."""

import copy
import warnings
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.optimize.convolution import FusedConvolution
from stereokit.optimize.fusion import Chain, find_chains, fuse
from stereokit.runtime.precision import dtype_of
from stereokit.runtime.processor import cpu_has

__all__ = ["PreparedNetwork", "prepare_for_inference"]

EXAMPLE_SIZE = (256, 512)


class PreparedNetwork(nn.Module):
    """What `prepare_for_inference` makes: a network whose weights are of one precision, called like the original.

    Args:
        network: in eval mode.
        precision: of its convolutions: "float32", "bfloat16" or "float16".

    Shape: as the network.
    """

    def __init__(self, network: nn.Module, precision: str) -> None:
        super().__init__()
        self.network = network
        self.precision = precision
        # what tiles are cut by
        for name in ("max_disparity", "multiple", "least_size"):
            if hasattr(network, name):
                setattr(self, name, getattr(network, name))

    @property
    def config(self) -> Any:
        """The network's own."""
        return self.network.config

    def forward(self, left: Tensor, right: Tensor, **options: Any) -> Any:
        """The network's own output."""
        if self.precision == "float32":
            return self.network(left, right, **options)
        # for what was not fused, and keeps its weights in single precision
        with torch.autocast(left.device.type, dtype_of(self.precision)):
            return self.network(left, right, **options)

    def train(self, mode: bool = True) -> "PreparedNetwork":
        """A prepared network stays in eval mode.

        Raises:
            ConfigError: training was asked for.
        """
        if mode:
            raise ConfigError("a prepared network can't be trained; train the original and prepare it again")
        return super().train(False)


def prepare_for_inference(
    model: nn.Module,
    *,
    precision: str = "float32",
    example: tuple[Tensor, Tensor] | None = None,
) -> PreparedNetwork:
    """A copy of a network that gives the same disparities faster; the network itself is not changed.

    Batch norms and activations are folded into the convolutions before them, and convolutions run in the memory format
    and through the kernels that are fast for them, see `FusedConvolution`. What belongs together is found by watching
    one forward pass, so this works for any network; blocks that it does not know are left as they are. The result can
    be compiled with `torch.compile` and exported with `torch.export`.

    On Linux, see `keep_freed_memory` too.

    Args:
        model: any ``forward(left, right)``, on the device that it will run on.
        precision: of the convolutions: "float32", "bfloat16" or "float16". In half precision, disparities,
            norms and softmaxes stay in single precision.
        example: images for the forward pass that is watched, by default (1, 3, 256, 512) without content.

    Raises:
        ConfigError: an unknown precision, or the network is prepared already or can't be copied.
        torch.OutOfMemoryError: the example is too large for the device.

    Warns:
        UserWarning: the network fails on the example, and is only copied; or the CPU has no instructions for half
            precision.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=64)
    >>> fast = prepare_for_inference(model)
    >>> left, right = torch.rand(2, 1, 3, 64, 128)
    >>> with torch.inference_mode():
    ...     error = (fast(left, right).disparity - model.eval()(left, right).disparity).abs()
    >>> bool(error.median() < 1e-3)
    True
    """
    dtype = dtype_of(precision)
    if isinstance(model, PreparedNetwork):
        raise ConfigError("the network is prepared already; prepare the original")
    try:
        network = copy.deepcopy(model).requires_grad_(False).eval()
    except RuntimeError as error:
        reason = str(error).strip().split("\n")[0]
        raise ConfigError(
            f"a {type(model).__name__} can't be copied to be made ready for inference ({reason}); weights that are "
            "computed from others can where torch.nn.utils.parametrizations does it"
        ) from error
    fuse(network, chains_of(network, example))
    if precision != "float32":
        tensors = [*network.parameters(), *network.buffers()]
        if all(tensor.device.type == "cpu" for tensor in tensors) and not cpu_has(dtype):
            warnings.warn(f"this CPU has no instructions for {precision}: float32 is faster here", stacklevel=2)
        for module in network.modules():
            if isinstance(module, FusedConvolution):
                module.to(dtype)
    return PreparedNetwork(network, precision).eval()


def chains_of(network: nn.Module, example: tuple[Tensor, Tensor] | None) -> list[Chain]:
    """What can be fused in a network; nothing, with a warning, where it fails on the example."""
    left, right = example or torch.zeros(2, 1, 3, *EXAMPLE_SIZE)
    reason = ""
    # without data if the network can do without, then for real
    for twin, device in ((copy.deepcopy(network).to("meta"), "meta"), (network, device_of(network))):
        try:
            images = left.to(device), right.to(device)
            return find_chains(twin, partial(call, images=images))
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            reason = str(error).strip().split("\n")[0]
    warnings.warn(
        f"the network fails on a pair of {left.shape[-1]} x {left.shape[-2]} pixels ({reason}): it is used as it is; "
        f"example=(left, right) would give it another one",
        stacklevel=3,
    )
    return []


def call(network: nn.Module, images: tuple[Tensor, Tensor]) -> Any:
    """One forward pass."""
    return network(*images)


def device_of(network: nn.Module) -> torch.device:
    """Where the first weight lies; the CPU without weights."""
    return next((t.device for t in (*network.parameters(), *network.buffers())), torch.device("cpu"))
