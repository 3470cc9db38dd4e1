"""PyTorch as it is."""

from typing import Any, Literal, TypeAlias, get_args

import torch
from torch import Tensor, nn

from stereokit.backends.estimate import Estimate
from stereokit.errors import ConfigError
from stereokit.model import StereoOutput

__all__ = ["Precision", "TorchBackend"]

Precision: TypeAlias = Literal["float32", "bfloat16", "float16"]


class TorchBackend:
    """A network in eager PyTorch.

    Args:
        network: any module with `forward(left, right) -> StereoOutput`; it is moved to the device and put into eval
            mode.
        device: of torch.
        precision: "float32", or a half precision for autocast.

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
        if self.precision not in get_args(Precision):
            raise ConfigError(
                f"backend {self.name!r} computes in {', '.join(get_args(Precision))}; got precision={precision!r}"
            )
        self.device = device
        self.network = network.to(device).eval()

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Nothing is needed."""
        return 0.0

    @torch.inference_mode()
    def __call__(self, left: Tensor, right: Tensor) -> Estimate:
        """Images (B, 3, H, W) to disparity and confidence (B, H, W)."""
        half = self.precision != "float32"
        with torch.autocast(self.device.type, getattr(torch, self.precision) if half else None, enabled=half):
            output = self.forward(left.to(self.device), right.to(self.device))
        # copying to the CPU waits for the device
        confidence = None if output.confidence is None else output.confidence.float().cpu().numpy()
        return Estimate(output.disparity.float().cpu().numpy(), confidence)

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        """The network on its device."""
        output: StereoOutput = self.network(left, right)
        return output

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
