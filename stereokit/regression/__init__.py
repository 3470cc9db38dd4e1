"""Logits to disparity."""

from stereokit.regression.soft_argmin import SoftArgmin, TopKSoftArgmin, soft_argmin, top_k_mass, top_k_soft_argmin

__all__ = [
    "SoftArgmin",
    "TopKSoftArgmin",
    "soft_argmin",
    "top_k_mass",
    "top_k_soft_argmin",
]
