"""Networks: a recipe of a page each."""

from stereokit.models.coex import coex
from stereokit.models.dispnetc import DispNetC
from stereokit.models.gcnet import gcnet
from stereokit.models.psmnet import psmnet
from stereokit.models.stereonet import stereonet_8x, stereonet_16x

__all__ = ["DispNetC", "coex", "gcnet", "psmnet", "stereonet_8x", "stereonet_16x"]
