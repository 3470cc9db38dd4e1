"""Networks: a recipe of a page each."""

from stereokit.models.coex import coex
from stereokit.models.gcnet import gcnet
from stereokit.models.psmnet import psmnet

__all__ = ["coex", "gcnet", "psmnet"]
