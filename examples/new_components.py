"""A new cost volume and a new guidance, registered from outside the package and run in CoEx.

Run it with ``python examples/new_components.py``.
"""

import torch
from torch import Tensor, nn

from stereokit import build_model
from stereokit.costs.shift import shifted_stack
from stereokit.registry import COSTS, GUIDANCE


@COSTS.register("absolute_difference")
class AbsoluteDifference(nn.Module):
    """Absolute difference of left and shifted right features.

    The builder offers a cost `in_channels` and `planes`; all further arguments are the user's.
    """

    def __init__(self, *, in_channels: int, planes: int, channels: int = 16) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.out_channels = channels
        self.planes = planes
        self.project = nn.Conv2d(in_channels, channels, 1)

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Two (B, in_channels, H, W) to (B, channels, planes, H, W)."""
        left, right = self.project(left), self.project(right)
        return (left.unsqueeze(2) - shifted_stack(right, self.planes)).abs()


@GUIDANCE.register("gain")
class GainGuidance(nn.Module):
    """Scales the whole volume by one factor per pixel: `GCE` with a single channel."""

    def __init__(self, guide_channels: int, volume_channels: int) -> None:
        super().__init__()
        self.gain = nn.Conv2d(guide_channels, 1, 1)

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume (B, C, D, H, W) and guide (B, G, H, W) to the volume's shape."""
        return volume * self.gain(guide).sigmoid().unsqueeze(2)


def main() -> None:
    model = build_model(
        "coex", cost={"name": "absolute_difference", "channels": 12}, guidance="gain", max_disparity=64
    ).eval()
    left, right = torch.rand(2, 1, 3, 120, 200)
    with torch.inference_mode():
        disparity = model(left, right).disparity
    print(f"cost {model.config['cost']}, guidance {model.config['guidance']}: disparity {tuple(disparity.shape)}")


if __name__ == "__main__":
    main()
