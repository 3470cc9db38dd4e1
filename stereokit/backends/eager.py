"""PyTorch, operation by operation."""

import time
from typing import Any

import torch
from torch import Tensor, nn

from stereokit.backends.estimate import Estimate
from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError
from stereokit.optimize import PreparedNetwork, prepare_for_inference
from stereokit.optimize.inference import EXAMPLE_SIZE
from stereokit.runtime.precision import DTYPES

__all__ = ["TorchBackend"]


class TorchBackend:
    """A network in eager PyTorch, made ready for inference at the first pair, see `prepare_for_inference`.

    What runs is a prepared copy. `prepare` makes it anew when the weights of the network have changed, other than
    through `Tensor.data`, which leaves no trace.

    Args:
        network: any module with `forward(left, right) -> StereoOutput`; it is moved to the device and put into eval
            mode.
        device: of torch.
        precision: "float32", or a half precision for the convolutions.

    Raises:
        ConfigError: another precision.

    >>> from stereokit import build_model
    >>> backend = TorchBackend(build_model("coex", max_disparity=64), torch.device("cpu"))
    >>> backend(torch.rand(1, 3, 40, 50), torch.rand(1, 3, 40, 50)).disparity.shape
    (1, 40, 50)
    """

    name = "torch"

    def __init__(self, network: nn.Module, device: torch.device, precision: str | None = None) -> None:
        self.precision = precision or "float32"
        if self.precision not in DTYPES:
            raise ConfigError(f"backend {self.name!r} computes in {', '.join(DTYPES)}; got precision={precision!r}")
        self.device = device
        self.network = network.to(device).eval()
        self._ready: nn.Module | None = None
        self._parts: list[dict[str, Any]] = []
        self._made_from: list[tuple[int, ...]] = []

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Prepares the network, where it is new or its weights have changed."""
        start = time.perf_counter()
        if self._ready is not None and _state(self._parts) == self._made_from:
            return 0.0
        height, width = EXAMPLE_SIZE
        example = [images[:1, :, :height, :width].to(self.device) for images in (left, right)]
        self._ready = self.make_ready(
            prepare_for_inference(self.network, precision=self.precision, example=(example[0], example[1]))
        )
        self._parts = _parts(self.network)
        self._made_from = _state(self._parts)
        return time.perf_counter() - start

    def make_ready(self, network: PreparedNetwork) -> nn.Module:
        """What is called, from the prepared network."""
        return network

    def __call__(self, left: Tensor, right: Tensor) -> Estimate:
        """Images (B, 3, H, W) to disparity and confidence (B, H, W)."""
        if self._ready is None:
            self.prepare(left, right)
        assert self._ready is not None
        with torch.inference_mode():
            output: StereoOutput = self._ready(left.to(self.device), right.to(self.device))
        # copying to the CPU waits for the device
        return Estimate.of(output).checked(left)

    def describe(self) -> dict[str, Any]:
        """The network's configuration and size, in plain JSON."""
        parts: dict[str, Any] = {}
        try:
            parts["configuration"] = self.network.config
        except (AttributeError, ConfigError):
            # composed by hand
            parts["class"] = f"{type(self.network).__module__}.{type(self.network).__qualname__}"
        parts["parameters"] = sum(p.numel() for p in self.network.parameters())
        return parts


def _parts(network: nn.Module) -> list[dict[str, Any]]:
    """Where the modules of a network keep what they hold; a walk at each pair would take longer."""
    return [held for module in network.modules() for held in (module._parameters, module._buffers, module._modules)]


def _state(parts: list[dict[str, Any]]) -> list[tuple[int, ...]]:
    """What each part is, and for a tensor where it lies and how often it was written to."""
    return [
        # writes to tensors made in inference mode are not counted
        (id(held), held.data_ptr(), 0 if held.is_inference() else held._version)
        if isinstance(held, Tensor)
        else (id(held),)
        for part in parts
        for held in part.values()
    ]
