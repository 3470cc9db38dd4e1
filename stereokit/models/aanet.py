"""AANet and AANet+: a pyramid of correlation volumes, aggregated by 2D convolutions that sample where they like.

Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["aanet", "aanet_plus"]

COMMON: dict[str, Any] = {
    "cost": {"name": "groupwise_correlation", "groups": 1},
    "aggregation": "adaptive",
    "regression": "soft_argmin",
    "upsampler": "none",
}


def _refinements(body: str) -> list[dict[str, Any]]:
    """At half and at full size."""
    return [{"name": "warped", "stride": stride, "body": body} for stride in (2, 1)]


aanet = recipe(
    "aanet",
    "Features at strides 3 to 12, correlation and adaptive aggregation at all three, two warped refinements.",
    backbone="bottleneck_pyramid",
    refinements=_refinements("dilated"),
    **COMMON,
)
aanet_plus = recipe(
    "aanet_plus",
    "AANet with GA-Net's hourglass for features and for both refinements.",
    backbone="deformable_hourglass",
    refinements=_refinements("hourglass"),
    **COMMON,
)

DEFORMABLE = KeyMap([("deform_conv.", ""), ("offset_conv.", "places.")])
"""A deformable convolution."""


def _bottleneck(published: str, ours: str) -> list[tuple[str, str]]:
    return [
        *DEFORMABLE.under(f"{published}conv2.", f"{ours}conv2.0."),
        (f"{published}conv{{k}}.", f"{ours}conv{{k}}.0."),
        (f"{published}bn{{k}}.", f"{ours}conv{{k}}.1."),
        (f"{published}downsample.", f"{ours}skip."),
    ]


HOURGLASS = KeyMap(
    pair
    # the scales are numbered from 1 there, and climbed from the coarsest
    for pass_, suffix in (("1", "a"), ("2", "b"))
    for scale in range(1, 5)
    for pair in (
        *DEFORMABLE.under(f"conv{scale}{suffix}.", f"down{pass_}.{scale - 1}."),
        *DEFORMABLE.under(f"conv{scale}{suffix}.conv2.", f"down{pass_}.{scale - 1}.merge."),
        *layer(f"conv{scale}{suffix}.conv1.", f"down{pass_}.{scale - 1}.resample."),
        *layer(f"conv{scale}{suffix}.conv2.", f"down{pass_}.{scale - 1}.merge."),
        *layer(f"conv{scale}{suffix}.", f"down{pass_}.{scale - 1}."),
        *layer(f"deconv{scale}{suffix}.conv1.", f"up{pass_}.{4 - scale}.resample."),
        *layer(f"deconv{scale}{suffix}.conv2.", f"up{pass_}.{4 - scale}.merge."),
    )
)
"""The double hourglass."""

AGGREGATION = (
    *_bottleneck("aggregation.fusions.{n}.branches.{s}.0.", "aggregation.stack.{n}.within.{s}."),
    # of a finer scale there is a convolution for each halving, of a coarser one a single one
    *(
        (
            f"aggregation.fusions.{{n}}.fuse_layers.{target}.{source}.{step}",
            f"aggregation.stack.{{n}}.across.exchange.{target}.{source}.{ours}",
        )
        for target in range(3)
        for source in range(3)
        for step, ours in ((("{k}.", "{k}."),) if source < target else (("", "0."),))
    ),
    ("aggregation.final_conv.", "aggregation.heads."),
)
REFINEMENT = (
    ("refinement.{r}.conv1.", "refinements.{r}.of_images."),
    ("refinement.{r}.conv2.", "refinements.{r}.of_disparity."),
    ("refinement.{r}.final_conv.", "refinements.{r}.head."),
)

AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "Apache-2.0",
    "overrides": {"padding": "zeros", "corner": "top_right"},
}

publish(
    "aanet",
    keys=[
        ("feature_extractor.conv1.", "backbone.stem."),
        *(
            pair
            for number in (1, 2, 3)
            for pair in _bottleneck(f"feature_extractor.layer{number}.{{b}}.", f"backbone.layers.{number - 1}.{{b}}.")
        ),
        ("fpn.lateral_convs.", "backbone.laterals."),
        ("fpn.fpn_convs.", "backbone.heads."),
        *AGGREGATION,
        *(
            (f"refinement.{{r}}.dilated_blocks.{{b}}.{theirs}{{k}}.", f"refinements.{{r}}.body.{{b}}.conv{{k}}.{part}.")
            for theirs, part in (("conv", 0), ("bn", 1))
        ),
        *REFINEMENT,
    ],
    **AUTHORS,
)
publish(
    "aanet_plus",
    keys=[
        *layer("feature_extractor.conv_start.0.", "backbone.stem.0."),
        *layer("feature_extractor.conv_start.1.", "backbone.stem.1."),
        *DEFORMABLE.under("feature_extractor.conv_start.2.", "backbone.stem.2."),
        *HOURGLASS.under("feature_extractor.", "backbone.hourglass."),
        *(
            (f"fpn.out{scale}.{theirs}.", f"backbone.coarser.{scale - 1}.{ours}.")
            for scale in (1, 2)
            for theirs, ours in ((0, "0.0"), (1, "0.1"), (3, "1.0"), (4, "1.1"))
        ),
        *AGGREGATION,
        *DEFORMABLE.under("refinement.{r}.conv_start.", "refinements.{r}.body.0."),
        *HOURGLASS.under("refinement.{r}.", "refinements.{r}.body.1."),
        *REFINEMENT,
    ],
    **AUTHORS,
)
