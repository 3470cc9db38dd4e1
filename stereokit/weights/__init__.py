"""Weights that come with the library: a folder each, NETWORK.TAG, with a manifest that says where they are from."""

from stereokit.weights.shipped import (
    DEFAULTS,
    Manifest,
    default_weights,
    list_weights,
    load_weights,
    read_manifest,
    suggest_weights,
    weights_folder,
)

__all__ = [
    "DEFAULTS",
    "Manifest",
    "default_weights",
    "list_weights",
    "load_weights",
    "read_manifest",
    "suggest_weights",
    "weights_folder",
]
