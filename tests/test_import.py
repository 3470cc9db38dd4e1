import os
import subprocess
import sys

import pytest

import stereokit

PUBLIC_NAMES = [
    "AGGREGATIONS",
    "AdaptiveAggregation",
    "AdditiveGuidance",
    "AffinityGuidance",
    "AffinityPyramid",
    "AttentionHourglass",
    "BACKBONES",
    "BottleneckPyramid",
    "banet_2d",
    "banet_3d",
    "BilateralAggregation",
    "CANDIDATES",
    "COSTS",
    "CheckpointError",
    "CombinedVolume",
    "ConcatenationVolume",
    "ConfigError",
    "CorrelationVolume",
    "DeformableHourglass",
    "DifferenceVolume",
    "DispNetC",
    "DeepAggregation",
    "DilatedContext",
    "DisparityRange",
    "DisparityResult",
    "DoubleHourglass",
    "EdgeAwareRefinement",
    "Embedding",
    "EncoderDecoder",
    "ExportedFile",
    "FastACVNet",
    "FastACVNetPlus",
    "FeaturePyramid",
    "GCE",
    "GUIDANCE",
    "GroupwiseCorrelationVolume",
    "GwcHourglass",
    "GwcTrunk",
    "HD3S",
    "HD3SC",
    "Hourglass",
    "ImageSuperpixelUpsampler",
    "InputError",
    "InterlacedVolume",
    "InvertedResidualHourglass",
    "LOSSES",
    "LevelPathAggregation",
    "LevelPathBackbone",
    "LocalGuidedSoftArgmin",
    "MODELS",
    "MostProbablePair",
    "MSCA",
    "MatchingNetwork",
    "Mode",
    "MostProbable",
    "NeighborhoodAggregation",
    "NeighborhoodRange",
    "PlainAggregation",
    "Predictor",
    "REFINEMENTS",
    "REGRESSIONS",
    "RepeatedHourglass",
    "ResidualTower",
    "ScalingGuidance",
    "SemiGlobalGuidance",
    "SeparableHourglass",
    "SeparableTrunk",
    "ShortcutHourglass",
    "SoftArgmin",
    "SpatialPyramid",
    "StackedHourglass",
    "StereoKitError",
    "StereoModel",
    "StereoNetwork",
    "StereoOutput",
    "StridedTower",
    "SubPixelMap",
    "SuperpixelUpsampler",
    "TopDownPyramid",
    "TopKSoftArgmin",
    "UNet",
    "UPSAMPLERS",
    "UniformCandidates",
    "WEIGHTS",
    "WarpedRefinement",
    "WithConfidence",
    "WithOffsets",
    "WithPropagation",
    "WithUpsampling",
    "__version__",
    "aanet",
    "aanet_plus",
    "acfnet",
    "acfnet_uniform",
    "build_model",
    "casstereo_gwc",
    "casstereo_psm",
    "cdn_psmnet",
    "coex",
    "cspn",
    "ganet_11",
    "ganet_deep",
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
    "mobilestereonet_2d",
    "mobilestereonet_3d",
    "open_network",
    "pdsnet",
    "psmnet",
    "stereo_loss",
    "stereonet_16x",
    "stereonet_8x",
]

NOT_CORE = [
    "lightning",
    "pytorch_lightning",
    "matplotlib",
    "gradio",
    "onnx",
    "onnxruntime",
    "openvino",
    "nncf",
    "tensorboard",
    "pandas",
    "laspy",
]
COSTLY = ["timm", "torchvision"]


def run(program, *options):
    """What a fresh interpreter prints; it fails where the program does."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run([sys.executable, *options, "-c", program], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def test_the_public_names_are_frozen():
    assert sorted(stereokit.__all__) == sorted(PUBLIC_NAMES)


@pytest.mark.parametrize("name", PUBLIC_NAMES)
def test_public_names_are_there(name):
    assert getattr(stereokit, name) is not None


def test_import_warns_of_nothing_and_takes_core_dependencies_only():
    program = "import sys, stereokit; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = run(program, "-W", "error").split()
    assert "torch" in loaded
    assert set(loaded).isdisjoint(NOT_CORE + COSTLY)


def test_nothing_but_core_dependencies_is_needed():
    """With all else hidden, the main networks are built and run."""
    program = f"""
import sys
sys.modules.update(dict.fromkeys({[*NOT_CORE, "pytest", "hypothesis"]!r}))  # an import of None fails
import torch, stereokit
model = stereokit.build_model("coex", max_disparity=64).eval()
print(tuple(model(torch.rand(1, 3, 32, 64), torch.rand(1, 3, 32, 64)).disparity.shape))
"""
    assert run(program) == "(1, 32, 64)\n"


EVERY_MODULE_FIRST = """
import importlib, pkgutil, sys
import stereokit
loaded = dict(sys.modules)
names = [m.name for m in pkgutil.walk_packages(stereokit.__path__, "stereokit.") if not m.name.endswith("__main__")]
for name in names:
    for other in [n for n in sys.modules if n.startswith("stereokit.") and n not in loaded]:
        del sys.modules[other]
    try:
        importlib.import_module(name)
    except ImportError as error:
        if (error.name or "").startswith("stereokit"):
            print(name, error)
print(len(names), "modules")
"""


@pytest.mark.slow
def test_every_module_can_be_the_first_that_is_imported_after_the_package():
    """None depends on others having been imported before: that would fail for some users and for no test."""
    # walking the packages imports them in the order of the alphabet, which this undoes
    *failed, count = run(EVERY_MODULE_FIRST).splitlines()
    assert not failed, failed
    assert int(count.split()[0]) > 100


def test_a_folder_of_the_same_name_beside_a_script_hides_nothing(tmp_path):
    (tmp_path / "stereokit").mkdir()
    script = tmp_path / "script.py"
    script.write_text("from stereokit import Predictor")
    subprocess.run([sys.executable, script], cwd=tmp_path, check=True, timeout=120)
