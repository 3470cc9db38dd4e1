"""Cost volumes to logits over disparity."""

from stereokit.aggregation.encoder_decoder import EncoderDecoder
from stereokit.aggregation.gwc_hourglass import GwcHourglass
from stereokit.aggregation.hourglass import Hourglass
from stereokit.aggregation.inverted_residual import InvertedResidualHourglass
from stereokit.aggregation.level_path import LevelPathAggregation
from stereokit.aggregation.plain import PlainAggregation
from stereokit.aggregation.stacked_hourglass import StackedHourglass

__all__ = [
    "EncoderDecoder",
    "GwcHourglass",
    "Hourglass",
    "InvertedResidualHourglass",
    "LevelPathAggregation",
    "PlainAggregation",
    "StackedHourglass",
]
