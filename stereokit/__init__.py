"""Stereo matching components: blocks registered by name, and a builder that composes them into networks."""

from stereokit._version import __version__
from stereokit.aggregation import (
    EncoderDecoder,
    GwcHourglass,
    Hourglass,
    InvertedResidualHourglass,
    LevelPathAggregation,
    PlainAggregation,
    StackedHourglass,
)
from stereokit.backbones import (
    FeaturePyramid,
    GwcTrunk,
    LevelPathBackbone,
    ResidualTower,
    SpatialPyramid,
    StridedTower,
    TopDownPyramid,
    UNet,
)
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
from stereokit.guidance import GCE, MSCA, AdditiveGuidance, NeighborhoodAggregation
from stereokit.inference import DisparityResult, Predictor
from stereokit.losses import stereo_loss
from stereokit.model import StereoModel
from stereokit.models import (
    DispNetC,
    casstereo_gwc,
    casstereo_psm,
    coex,
    gcnet,
    gwcnet_g,
    gwcnet_gc,
    leastereo,
    lightstereo_l,
    lightstereo_m,
    lightstereo_s,
    psmnet,
    stereonet_8x,
    stereonet_16x,
)
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
from stereokit.upsampling import ImageSuperpixelUpsampler, SuperpixelUpsampler
from stereokit.weights import list_weights, load_weights
from stereokit.weights.opening import ExportedFile, open_network
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
    "MSCA",
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
    "ExportedFile",
    "FeaturePyramid",
    "GroupwiseCorrelationVolume",
    "GwcHourglass",
    "GwcTrunk",
    "Hourglass",
    "ImageSuperpixelUpsampler",
    "InputError",
    "InvertedResidualHourglass",
    "LevelPathAggregation",
    "LevelPathBackbone",
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
    "TopDownPyramid",
    "TopKSoftArgmin",
    "UNet",
    "UniformCandidates",
    "__version__",
    "build_model",
    "casstereo_gwc",
    "casstereo_psm",
    "coex",
    "gcnet",
    "gwcnet_g",
    "gwcnet_gc",
    "leastereo",
    "lightstereo_l",
    "lightstereo_m",
    "lightstereo_s",
    "list_components",
    "list_models",
    "list_weights",
    "load_published",
    "load_weights",
    "open_network",
    "psmnet",
    "stereo_loss",
    "stereonet_8x",
    "stereonet_16x",
]
