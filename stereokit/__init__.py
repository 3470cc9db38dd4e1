"""Stereo matching components: blocks registered by name, and a builder that composes them into networks."""

from stereokit._version import __version__
from stereokit.aggregation import EncoderDecoder, Hourglass, PlainAggregation, StackedHourglass
from stereokit.backbones import ResidualTower, SpatialPyramid, StridedTower, UNet
from stereokit.builder import build_model
from stereokit.candidates import DisparityRange, NeighborhoodRange, UniformCandidates
from stereokit.contracts import StereoOutput
from stereokit.costs import (
    CombinedVolume,
    ConcatenationVolume,
    CorrelationVolume,
    DifferenceVolume,
    GroupwiseCorrelationVolume,
)
from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError
from stereokit.guidance import GCE, AdditiveGuidance, NeighborhoodAggregation
from stereokit.inference import DisparityResult, Predictor
from stereokit.losses import stereo_loss
from stereokit.model import StereoModel
from stereokit.models import DispNetC, coex, gcnet, psmnet, stereonet_8x, stereonet_16x
from stereokit.network import StereoNetwork
from stereokit.refinement import EdgeAwareRefinement
from stereokit.registry import (
    AGGREGATIONS,
    BACKBONES,
    CANDIDATES,
    COSTS,
    GUIDANCE,
    LOSSES,
    MODELS,
    REFINEMENTS,
    REGRESSIONS,
    UPSAMPLERS,
    WEIGHTS,
    list_components,
    list_models,
)
from stereokit.regression import SoftArgmin, TopKSoftArgmin
from stereokit.upsampling import SuperpixelUpsampler
from stereokit.weights import list_weights, load_weights
from stereokit.weights.published import load_published

__all__ = [
    "AGGREGATIONS",
    "BACKBONES",
    "CANDIDATES",
    "COSTS",
    "GCE",
    "GUIDANCE",
    "LOSSES",
    "MODELS",
    "REFINEMENTS",
    "REGRESSIONS",
    "UPSAMPLERS",
    "WEIGHTS",
    "AdditiveGuidance",
    "CheckpointError",
    "CombinedVolume",
    "ConcatenationVolume",
    "ConfigError",
    "CorrelationVolume",
    "DifferenceVolume",
    "DispNetC",
    "DisparityRange",
    "DisparityResult",
    "EdgeAwareRefinement",
    "EncoderDecoder",
    "GroupwiseCorrelationVolume",
    "Hourglass",
    "InputError",
    "NeighborhoodAggregation",
    "NeighborhoodRange",
    "PlainAggregation",
    "Predictor",
    "ResidualTower",
    "SoftArgmin",
    "SpatialPyramid",
    "StackedHourglass",
    "StereoKitError",
    "StereoModel",
    "StereoNetwork",
    "StereoOutput",
    "StridedTower",
    "SuperpixelUpsampler",
    "TopKSoftArgmin",
    "UNet",
    "UniformCandidates",
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
    "stereonet_8x",
    "stereonet_16x",
]
