"""Cost volumes to logits over disparity."""

from stereokit.aggregation.encoder_decoder import EncoderDecoder
from stereokit.aggregation.hourglass import Hourglass
from stereokit.aggregation.plain import PlainAggregation
from stereokit.aggregation.stacked_hourglass import StackedHourglass

__all__ = ["EncoderDecoder", "Hourglass", "PlainAggregation", "StackedHourglass"]
