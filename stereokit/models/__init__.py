"""Networks: a recipe of a page each."""

from stereokit.models.coex import coex
from stereokit.models.gcnet import gcnet
from stereokit.models.lightstereo import lightstereo_l, lightstereo_m, lightstereo_s
from stereokit.models.psmnet import psmnet

__all__ = ["coex", "gcnet", "lightstereo_l", "lightstereo_m", "lightstereo_s", "psmnet"]
