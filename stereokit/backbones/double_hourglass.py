"""The feature extractor of GANet: an hourglass run through twice, and a branch that guides."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ConvNormAct, TwofoldHourglass, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["DoubleHourglass"]


def conv(in_channels: int, out_channels: int, kernel_size: int = 3, stride: int = 1) -> ConvNormAct:
    """With ReLU."""
    return ConvNormAct(in_channels, out_channels, kernel_size, stride=stride, activation=relu)


class GuidanceBranch(nn.Module):
    """Maps of the left view that guide: at full size, and at strides 3 and 6."""

    def __init__(self) -> None:
        super().__init__()
        self.image = nn.Sequential(conv(3, 16), conv(16, 32))
        self.feature = nn.Conv2d(32, 32, 3, padding=1, bias=False)
        init_convolutions(self.feature)
        self.norm = nn.BatchNorm2d(32)
        self.merge = conv(64, 16)
        self.third = nn.Sequential(conv(16, 32, 5, stride=3), conv(32, 32))
        self.sixth = nn.Sequential(conv(32, 48, stride=2), conv(48, 48))

    def forward(self, image: Tensor, feature: Tensor) -> dict[int, Tensor]:
        """Image (B, 3, H, W) and feature (B, 32, H/3, W/3) to maps by stride."""
        enlarged = F.interpolate(self.feature(feature), size=image.shape[-2:], mode="bilinear", align_corners=False)
        full = self.merge(torch.cat((self.image(image), F.relu(self.norm(enlarged))), dim=1))
        third = self.third(full)
        return {1: full, 3: third, 6: self.sixth(third)}


@BACKBONES.register("double_hourglass")
class DoubleHourglass(nn.Module):
    """Three convolutions down to stride 3, an hourglass run through twice, and a guidance branch for the left view.

    The views are not treated alike: each has a last convolution of its own, and guides are of the left one alone.

    Shape: two (B, 3, H, W), sides multiples of 48, to two `Features`: matching (B, 32, H/3, W/3), guides of the left
    one {1: 16, 3: 32, 6: 48}.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, appendix A.

    >>> left, right = DoubleHourglass().eval()(*torch.rand(2, 1, 3, 48, 96))
    >>> left.matching[3].shape, list(left.guides), list(right.guides)
    (torch.Size([1, 32, 16, 32]), [1, 3, 6], [])
    """

    multiple = 48
    paired = True

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(conv(3, 32), conv(32, 32, 5, stride=3), conv(32, 32))
        self.hourglass = TwofoldHourglass()
        self.left_head, self.right_head = conv(32, 32), conv(32, 32)
        self.guidance = GuidanceBranch()
        self.info = FeatureInfo(matching_channels={3: 32}, guide_channels={1: 16, 3: 32, 6: 48})

    def forward(self, left: Tensor, right: Tensor) -> tuple[Features, Features]:
        """Images to features."""
        of_left, of_right = self.hourglass(self.stem(torch.cat((left, right)))).chunk(2)
        guides = self.guidance(left, of_left)
        return Features({3: self.left_head(of_left)}, guides), Features({3: self.right_head(of_right)}, {})
