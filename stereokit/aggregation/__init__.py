"""Cost volumes to logits over disparity."""

from stereokit.aggregation.adaptive import AdaptiveAggregation, CrossScale
from stereokit.aggregation.attention_hourglass import AttentionHourglass
from stereokit.aggregation.attention_propagation import AttentionPropagation, propagate_attention
from stereokit.aggregation.bilateral import BilateralAggregation, ScaleAwareAttention
from stereokit.aggregation.dilated_context import DilatedContext
from stereokit.aggregation.encoder_decoder import EncoderDecoder
from stereokit.aggregation.gwc_hourglass import GwcHourglass
from stereokit.aggregation.hourglass import Hourglass
from stereokit.aggregation.inverted_residual import InvertedResidualHourglass
from stereokit.aggregation.level_path import LevelPathAggregation
from stereokit.aggregation.plain import PlainAggregation
from stereokit.aggregation.repeated_hourglass import RepeatedHourglass
from stereokit.aggregation.separable_hourglass import SeparableHourglass
from stereokit.aggregation.shortcut_hourglass import ShortcutHourglass
from stereokit.aggregation.stacked_hourglass import StackedHourglass
from stereokit.aggregation.with_confidence import ConfidenceNetwork, WithConfidence
from stereokit.aggregation.with_offsets import WithOffsets
from stereokit.aggregation.with_propagation import WithPropagation
from stereokit.aggregation.with_upsampling import LearnedUpsampling, WithUpsampling, learned_upsample

__all__ = [
    "AdaptiveAggregation",
    "AttentionHourglass",
    "AttentionPropagation",
    "BilateralAggregation",
    "ConfidenceNetwork",
    "CrossScale",
    "DilatedContext",
    "EncoderDecoder",
    "GwcHourglass",
    "Hourglass",
    "InvertedResidualHourglass",
    "LearnedUpsampling",
    "LevelPathAggregation",
    "PlainAggregation",
    "RepeatedHourglass",
    "ScaleAwareAttention",
    "SeparableHourglass",
    "ShortcutHourglass",
    "StackedHourglass",
    "WithConfidence",
    "WithOffsets",
    "WithPropagation",
    "WithUpsampling",
    "learned_upsample",
    "propagate_attention",
]
