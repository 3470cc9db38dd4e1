"""Stereo matching components: blocks registered by name, and a builder that composes them into networks."""

from stereokit._version import __version__
from stereokit.aggregation import (
    GCE,
    AdditiveGuidance,
    EncoderDecoder,
    Hourglass,
    NeighborhoodAggregation,
    StackedHourglass,
)
from stereokit.backbones import ResidualTower, SpatialPyramid, UNet
from stereokit.builder import build_model
from stereokit.costs import ConcatenationVolume, CorrelationVolume, GroupwiseCorrelationVolume
from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError
from stereokit.inference import DisparityResult, Predictor
from stereokit.losses import stereo_loss
from stereokit.model import StereoModel, StereoOutput
from stereokit.models import coex, gcnet, psmnet
from stereokit.published import load_published
from stereokit.registry import (
    AGGREGATIONS,
    BACKBONES,
    COSTS,
    GUIDANCE,
    MODELS,
    REGRESSIONS,
    UPSAMPLERS,
    WEIGHTS,
    list_components,
    list_models,
)
from stereokit.regression import SoftArgmin, SuperpixelUpsampler, TopKSoftArgmin
from stereokit.weights import list_weights, load_weights

__all__ = [
    "AGGREGATIONS",
    "BACKBONES",
    "COSTS",
    "GCE",
    "GUIDANCE",
    "MODELS",
    "REGRESSIONS",
    "UPSAMPLERS",
    "WEIGHTS",
    "AdditiveGuidance",
    "CheckpointError",
    "ConcatenationVolume",
    "ConfigError",
    "CorrelationVolume",
    "DisparityResult",
    "EncoderDecoder",
    "GroupwiseCorrelationVolume",
    "Hourglass",
    "InputError",
    "NeighborhoodAggregation",
    "Predictor",
    "ResidualTower",
    "SoftArgmin",
    "SpatialPyramid",
    "StackedHourglass",
    "StereoKitError",
    "StereoModel",
    "StereoOutput",
    "SuperpixelUpsampler",
    "TopKSoftArgmin",
    "UNet",
    "__version__",
    "build_model",
    "coex",
    "gcnet",
    "list_components",
    "list_models",
    "list_weights",
    "load_published",
    "load_weights",
    "psmnet",
    "stereo_loss",
]
