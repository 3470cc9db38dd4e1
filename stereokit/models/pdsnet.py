"""PDS-Net: a matching network at each disparity, and a range that can be set after training.

Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching", NeurIPS 2018.
"""

from torch import Tensor

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["pdsnet"]

pdsnet = recipe(
    "pdsnet",
    "A matching network at each disparity of stride 4, an hourglass to full size, the mean around the largest logit.",
    backbone="embedding",
    cost="matching_network",
    aggregation="shortcut_hourglass",
    regression="sub_pixel_map",
    upsampler="none",
    statistics="image",
)

RESIDUAL = KeyMap([("convolutions.0.", "conv1."), ("convolutions.1.", "conv2.")])


def _split(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The first convolution of the matching network, by view."""
    both = state["cost.of_left.weight"]
    state["cost.of_left.weight"], state["cost.of_right.weight"] = both.chunk(2, dim=1)
    return state


publish(
    "pdsnet",
    source="the authors' checkpoints",
    licence="BSD-2",
    convert=_split,
    # the norm of their input sees the padding
    overrides={"padding": "black", "corner": "top_left"},
    keys=[
        ("_embedding._shortcut.", "aggregation.shortcut."),
        *RESIDUAL.under("_embedding._embedding_modules.{n}.", "backbone.layers.{n-1}."),
        ("_embedding._embedding_modules.{n}.", "backbone.layers.{n-1}."),
        ("_matching._operation._matching_operation_modules.0.", "cost.of_left."),
        ("_matching._operation._matching_operation_modules.3.", "cost.head."),
        *RESIDUAL.under("_matching._operation._matching_operation_modules.{n}.", "cost.blocks.{n-1}."),
        ("_regularization._smoothing.", "aggregation.smooth."),
        ("_regularization._contraction_blocks.{n}._downsampling_2x.", "aggregation.down.{n}.down."),
        ("_regularization._contraction_blocks.{n}._smoothing.", "aggregation.down.{n}.smooth."),
        ("_regularization._expansion_blocks.{n}._upsampling_2x.", "aggregation.up.{n}.up."),
        ("_regularization._expansion_blocks.{n}._smoothing.", "aggregation.up.{n}.smooth."),
        ("_regularization._upsample_to_halfsize.", "aggregation.to_half_size."),
        ("_regularization._upsample_to_fullsize.", "aggregation.to_full_size."),
    ],
)
