"""The stereo network of CSPN, as far as it is known: the authors did not release it.

Known is its outline: PSMNet with affinity pooling and fusion in place of the pyramid, and a 3D propagation behind each
of the three outputs. Chosen here are where the pooling sits and its cells (those of a third-party rebuild), the number
of steps, and that the three outputs are supervised as PSMNet's are and not fused.

Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019.
"""

from stereokit.builder import recipe

__all__ = ["cspn"]

cspn = recipe(
    "cspn",
    "PSMNet with pooling and fusion by affinity, and logits that spread in three dimensions.",
    backbone="affinity_pyramid",
    cost="concatenation",
    aggregation={"name": "with_propagation", "base": "stacked_hourglass"},
    regression="soft_argmin",
    upsampler="trilinear",
)
