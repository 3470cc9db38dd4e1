"""A learned projection of the matching features before they are compared."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, init_convolutions, named_activation

__all__ = ["Projected", "Projection"]

Projected: TypeAlias = Sequence[int] | Mapping[str, Any] | None
"""What costs take: widths, or a mapping of the arguments of `Projection` but the first; None for none."""


class Projection(nn.Module):
    """Convolutions 3x3 with norm and activation, then one alone, on both views alike; or nothing.

    Args:
        in_channels: of the features.
        widths: channels after each convolution; None leaves the features as they are. A mapping holds these arguments
            by name.
        activation: "leaky_relu", "relu", ..., see `named_activation`.
        bias: of the last convolution.
        last_kernel: its size.

    Shape: two (B, in_channels, H, W) to two (B, out_channels, H, W).

    Raises:
        ConfigError: no widths, or an unknown activation.

    Source: CoEx, section "Matching cost computation".

    >>> Projection(96, (48, 24)).out_channels, Projection(320, {"widths": [12], "bias": False}).out_channels
    (24, 12)
    """

    def __init__(
        self,
        in_channels: int,
        widths: Projected,
        *,
        activation: str = "leaky_relu",
        bias: bool = True,
        last_kernel: int = 1,
    ) -> None:
        super().__init__()
        self.layers = nn.Sequential()
        self.out_channels = in_channels
        if isinstance(widths, Mapping):
            given = {"activation": activation, "bias": bias, "last_kernel": last_kernel, **widths}
            if given.keys() != {"widths", "activation", "bias", "last_kernel"}:
                raise ConfigError(
                    "a projection has widths, an activation, a bias and a last_kernel; got "
                    f"{', '.join(map(str, widths)) or 'nothing'}"
                )
            widths, activation, bias, last_kernel = (
                given[key] for key in ("widths", "activation", "bias", "last_kernel")
            )
        layers = [] if widths is None else list(widths)
        if widths is not None and not layers:
            raise ConfigError("a projection has one width or more; leave it out (None) for no projection")
        for channels in layers[:-1]:
            self.layers.append(ConvNormAct(self.out_channels, channels, activation=named_activation(activation)))
            self.out_channels = channels
        if layers:
            self.layers.append(
                nn.Conv2d(self.out_channels, layers[-1], last_kernel, padding=last_kernel // 2, bias=bias)
            )
            self.out_channels = layers[-1]
        init_convolutions(self.layers)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Left and right features to projected ones."""
        if not self.layers:
            return left, right
        left, right = self.layers(torch.cat((left, right))).chunk(2)
        return left, right
