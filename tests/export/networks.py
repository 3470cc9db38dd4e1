"""Networks that are exported in a moment."""

import torch
from torch import Tensor, nn

from stereokit import StereoOutput


class Tiny(nn.Module):
    """One convolution; padded to a multiple of 8 as the big ones are."""

    multiple = 8
    max_disparity = 16

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(6, 2, 3, padding=1, stride=2)

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        if left.dtype == torch.uint8:
            left, right = left / 255, right / 255
        height, width = left.shape[-2:]
        bottom, side = ((size + 7) // 8 * 8 - size for size in (height, width))
        images = nn.functional.pad(torch.cat((left, right), dim=1), (0, side, 0, bottom), mode="replicate")
        maps = nn.functional.interpolate(self.conv(images).sigmoid(), scale_factor=2.0, mode="bilinear")
        maps = maps[..., :height, :width]
        return StereoOutput(16 * maps[:, 0], confidence=maps[:, 1])


class Untrue(nn.Module):
    """Gives something else than what is exported."""

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        disparity = left.mean(1)
        return StereoOutput(disparity if torch.compiler.is_exporting() else disparity + 1)
