"""What a guidance block is given, against what it was made for."""

import torch
from torch import Tensor

from stereokit.errors import InputError

__all__ = ["check_guide"]


def check_guide(volume: Tensor, guide: Tensor, volume_channels: int, guide_channels: int) -> None:
    """Raises `InputError` unless a volume and a guide have these channels and meet pixel by pixel."""
    fits = (
        volume.dim() == 5
        and guide.dim() == 4
        and (volume.shape[1], guide.shape[1]) == (volume_channels, guide_channels)
        # sizes that an export leaves open would be bound by looking at them
        and (torch.compiler.is_compiling() or (volume.shape[0], *volume.shape[-2:]) == (len(guide), *guide.shape[-2:]))
    )
    if not fits:
        raise InputError(
            f"the guidance wants a volume (B, {volume_channels}, D, H, W) and a guide (B, {guide_channels}, H, W) of "
            f"its height and width; got {tuple(volume.shape)} and {tuple(guide.shape)}"
        )
