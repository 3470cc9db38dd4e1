"""LEAStereo: features and aggregation whose cells and scales were found by search.

Cheng et al., "Hierarchical neural architecture search for deep stereo matching", NeurIPS 2020.
"""

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["leastereo"]

leastereo = recipe(
    "leastereo",
    "Searched cells at strides 3 and 6, concatenation at stride 3, searched cells of 3D convolutions, soft-argmin.",
    backbone="level_path",
    cost="concatenation",
    aggregation="level_path",
    regression="soft_argmin",
    upsampler="trilinear",
    statistics="image",
)

CELLS = KeyMap(
    [
        *layer("cells.{n}.pre_preprocess.", "path.cells.{n}.enter.0."),
        *layer("cells.{n}.preprocess.", "path.cells.{n}.enter.1."),
        # two edges to a node, in the order in which they are used, which is not that of the stored genotype
        *(
            pair
            for i in range(6)
            for pair in layer(f"cells.{{n}}._ops.{i}.", f"path.cells.{{n}}.convs.{i // 2}.{i % 2}.")
        ),
    ]
)

publish(
    "leastereo",
    source="the authors' checkpoints",
    licence="MIT",
    overrides={"padding": "zeros", "corner": "top_left"},
    negated=("matching.last_3.conv.",),
    # members of the output ladders, and the norms of the last convolutions
    unused=(
        "feature.last_3.bn.",
        "feature.last_6.",
        "feature.last_12.",
        "feature.last_24.",
        "matching.last_3.bn.",
        "matching.last_12.",
        "matching.last_24.",
    ),
    keys=[
        *layer("feature.stem{n}.", "backbone.stem{n}."),
        *CELLS.under("feature.", "backbone."),
        ("feature.last_3.conv.", "backbone.head."),
        *layer("matching.stem{n}.", "aggregation.stem{n}."),
        *CELLS.under("matching.", "aggregation."),
        *layer("matching.conv1.", "aggregation.path.merge.4."),
        *layer("matching.conv2.", "aggregation.path.merge.8."),
        *layer("matching.last_6.", "aggregation.ladder.0."),
        ("matching.last_3.conv.", "aggregation.head."),
    ],
)
