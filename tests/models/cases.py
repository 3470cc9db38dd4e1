"""What every registered network is held to: an entry each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

from stereokit.config import IMAGENET_MEAN, IMAGENET_STD

__all__ = ["CASES", "QUICK", "Case", "Golden", "Tap"]

ALL_EXPORTS = ("onnx", "openvino", "program")


@dataclass(frozen=True)
class Tap:
    """What a recording holds of the inside of a network.

    Args:
        module: whose output it is.
        steps: of the last axes that were kept, such as "6/4/4".
        item: of an output that is a tuple, or the key of one that is a mapping; several where they are nested.
        field: of a named tuple.
        left: the left half of a batch of both views.
        sign: -1 where lower is better there, or another factor.
    """

    module: str
    steps: str = ""
    item: int | tuple[int, ...] | None = None
    field: str | None = None
    left: bool = False
    sign: float = 1

    def read(self, output: Any) -> Tensor:
        """The recorded part of a module's output."""
        if self.field is not None:
            output = getattr(output, self.field)
        for item in (self.item,) if isinstance(self.item, int) else self.item or ():
            output = output[item]
        if self.left:
            output = output.chunk(2)[0]
        steps = [int(step) for step in self.steps.split("/") if step]
        return self.sign * output[(..., *(slice(None, None, step) for step in steps))]


@dataclass(frozen=True)
class Golden:
    """A recording of the published network.

    Args:
        name: of the recording.
        norm: range of the norms' weights.
        taps: by the name of the array.
        seed: of the weights.
        overrides: of `load_published`.
        logits: largest difference of the taps, in parts of their spread.
        pixels: share of pixels whose disparity is within 0.01 px.
        disparity: the name of its array.
        sign: -1 where it is flow to the left.
    """

    name: str
    norm: tuple[float, float]
    taps: Mapping[str, Tap] = field(default_factory=dict)
    seed: int = 1
    overrides: Mapping[str, Any] = field(default_factory=dict)
    logits: float = 1e-4
    pixels: float = 1.0
    disparity: str = "disparity"
    sign: int = 1


@dataclass(frozen=True)
class Case:
    """What is known of a network.

    Args:
        parameters: learned numbers.
        golden: its recording, or why there is none.
        training_only: parameters that are used in training alone.
        loss: of its paper.
        exports: the formats that it can be written in.
        no_export: why not the others.
        max_disparity: that the quick tests run at.
        overrides: likewise.
        size: that the quick tests run at, height and width; multiples of what the network pads to.
        seam: the mean difference in px that tiles make, at most, with random weights.
        rounding: px that kernels which add in another order may differ by, at nearly all pixels, with random weights.
    """

    parameters: int
    golden: Golden | str
    training_only: int = 0
    loss: str | Mapping[str, Any] = "smooth_l1"
    exports: tuple[str, ...] = ALL_EXPORTS
    no_export: str = ""
    max_disparity: int = 64
    overrides: Mapping[str, Any] = field(default_factory=dict)
    size: tuple[int, int] = (64, 96)
    seam: float = 3.0
    rounding: float = 0.01


def _lightstereo(size: str, parameters: int, **rest: Any) -> Case:
    taps = {"volume": Tap("cost", "2/2"), "aggregated": Tap("aggregation", item=-1)}
    return Case(parameters=parameters, golden=Golden(f"lightstereo_{size}", norm=(0.5, 0.75), taps=taps), **rest)


def _gwcnet(name: str) -> Golden:
    taps = {"volume": Tap("cost", "6/4/4"), "head3": Tap("aggregation", "2/2/2", item=-1)}
    return Golden(name, norm=(0.5, 0.75), taps=taps)


def _aanet(recorded: str, parameters: int, **rest: Any) -> Case:
    taps = {"cost_3": Tap("cost", "4/4"), "logits_3": Tap("aggregation", "3/3", item=-1)}
    golden = Golden(recorded, norm=(0.4, 0.65), taps=taps)
    # the coarse outputs of the last module; 71,280 at 192 px
    return Case(parameters=parameters, training_only=4_524, golden=golden, max_disparity=48, **rest)


def _casstereo(name: str, lowest: float, head1: str) -> Golden:
    return Golden(
        name,
        norm=(lowest, 0.75),
        taps={
            "head1": Tap("coarse.0.aggregation", head1, item=-1),
            "stage1": Tap("coarse.0.regression", "2/2"),
            "range2": Tap("candidates", "16/16", field="values"),
            "head2": Tap("aggregation", "4/4", item=-1),
        },
    )


def _ganet(parameters: int, training_only: int) -> Case:
    return Case(
        parameters=parameters,
        training_only=training_only,
        golden="two layers exist in CUDA alone, so nothing was recorded; its keys have a place in test_ganet.py",
        exports=(),
        no_export="torch 2.14 exports one SGA block, but fails or takes minutes over all scans of the network",
        max_disparity=48,
        size=(48, 96),
    )


ELSEWHERE = "held to its recordings in tests/weights/test_published.py"


def _raft(name: str, sides: str, levels: int) -> Golden:
    taps = {
        "feature_left": Tap("features", f"8/{sides}", left=True),
        "lookup_1": Tap("lookup", sides),
        "delta_1": Tap("update.head"),
        "hidden1_0": Tap("update.units.0", f"8/{sides}"),
    }
    if levels == 3:
        taps |= {"hidden1_1": Tap("update.units.1", "8/1/1"), "hidden1_2": Tap("update.units.2", "8/1/1")}
    return Golden(
        name,
        norm=(0.5, 0.7),
        taps=taps,
        overrides={"test_iterations": 4},
        logits=5e-4,
        disparity="flow",
        sign=-1,
    )


def _banet(name: str, norm: tuple[float, float], agg_0: Tap) -> Golden:
    cosine = name == "banet3d"
    return Golden(
        name,
        norm=norm,
        taps={
            "feature": Tap("backbone.merge_4", "2/2", left=True),
            "correlation": Tap("cost", "2/2", sign=1 / 48 if cosine else 1),
            "stem": Tap("aggregation.embedding", "2/1/4/4" if cosine else "4/4"),
            "attention": Tap("aggregation.attention"),
            "agg_0": agg_0,
            "logits": Tap("aggregation", "2/2", item=-1),
            "disparity_low": Tap("regression"),
        },
    )


def _hd3(name: str, parameters: int, lowest: float) -> Case:
    def level(number: int, stride: int) -> Tap:
        return Tap(f"levels.{number}", field="disparity", sign=-stride)

    return Case(
        # outer projections of trees of depth 2 are never read
        parameters=parameters - 41_728,
        golden=Golden(
            name,
            norm=(lowest, lowest + 0.2),
            taps={
                "vect0": level(0, 64),
                "prob3": Tap("levels.3.head"),
                "vect3": level(3, 8),
                "prob5": Tap("levels.5.head", "2/2"),
                "vect5": level(5, 2),
            },
        ),
        loss="density",
        size=(64, 128),
    )


CAFFE = "published for Caffe, with layers for GPUs alone"

NOT_COMMERCIAL = "its code, weights and outputs are not for commercial use; held to its keys in test_deeppruner.py"

STEREONET = {
    "feature": Tap("backbone.head", left=True),
    "cost": Tap("aggregation", item=0, sign=-1),
    "disparity_low": Tap("upsampler"),
    "refined_1": Tap("refinements.0"),
}

ALL_CANDIDATES = 96
"""Of Fast-ACVNet: where levels tie for the last place among its candidates, rounding moves all of a random network."""

QUICK = ("coex", "psmnet", "gwcnet_g", "stereonet_8x", "lightstereo_s", "dispnetc", "rt_igev")
"""One of each kind. The quick run builds and calls every network once, and goes on with these alone."""

CASES: dict[str, Case] = {
    "coex": Case(parameters=2_721_993, golden=ELSEWHERE),
    "psmnet": Case(parameters=5_224_768, golden=ELSEWHERE),
    "gcnet": Case(parameters=2_845_376, golden="no weights were published"),
    "ganet_deep": _ganet(6_573_552, 1_728),
    "ganet_11": _ganet(4_483_728, 864),
    "gwcnet_g": Case(parameters=6_518_560, training_only=85_728, golden=_gwcnet("gwcnet_g")),
    "gwcnet_gc": Case(parameters=6_909_728, training_only=85_728, golden=_gwcnet("gwcnet_gc")),
    "casstereo_psm": Case(
        parameters=10_505_568, training_only=2 * 85_728, golden=_casstereo("casstereo_psm", 0.5, "4/4"), rounding=0.5
    ),
    "casstereo_gwc": Case(
        parameters=10_943_776, training_only=2 * 85_728, golden=_casstereo("casstereo_gwc", 0.45, "2/2"), rounding=0.5
    ),
    # without the 192 disparities that its published weights hold
    "acfnet": Case(
        parameters=5_559_264 - 192,
        golden=Golden(
            "acfnet",
            norm=(0.5, 0.75),
            taps={
                "feature": Tap("backbone", "4/1/1", field="matching", item=4, left=True),
                "cost3": Tap("aggregation", "8/8/8", item=(-1, 0)),
                "confidence": Tap("", "2/2", field="confidence"),
            },
        ),
        loss="stereo_focal",
    ),
    "acfnet_uniform": Case(
        parameters=5_226_912 - 192,
        golden="the adaptive form alone was recorded; its keys have a place in test_acfnet.py",
        loss="stereo_focal",
    ),
    "cdn_psmnet": Case(
        parameters=5_310_496,
        golden=Golden(
            "cdn_psmnet",
            norm=(0.4, 0.6),
            # logits and offsets of the last head
            taps={
                "cost3": Tap("aggregation", "2/4/4", item=(-1, 0)),
                "off3": Tap("aggregation", "2/4/4", item=(-1, 1)),
            },
            # where two bins tie, rounding decides
            pixels=0.999,
        ),
        loss="wasserstein",
    ),
    # what the blocks give: the network was not released
    "cspn": Case(parameters=5_175_992, golden="its authors did not release it", max_disparity=32),
    "leastereo": Case(
        parameters=1_724_912,
        golden=Golden(
            "leastereo",
            norm=(0.65, 1.05),
            taps={
                "feature": Tap("backbone.head", left=True),
                "matching": Tap("aggregation", "2/2", item=-1, sign=-1),
            },
        ),
        max_disparity=48,
        size=(48, 72),
    ),
    "lightstereo_s": _lightstereo("s", 3_441_360),
    # their aggregation sees further than tiles overlap
    "lightstereo_m": _lightstereo("m", 7_641_264, seam=6.0),
    "lightstereo_l": _lightstereo("l", 24_286_512, seam=6.0, rounding=0.05),
    # of the published ones 32 are frozen and take a mean
    "banet_2d": Case(
        parameters=5_456_649 - 32, golden=_banet("banet2d", (0.6, 0.9), Tap("aggregation.heads.0", "2/2"))
    ),
    # and the 4 weights of two norms that are never read
    "banet_3d": Case(
        parameters=3_631_973 - 4,
        golden=_banet("banet3d", (0.5, 0.8), Tap("aggregation.branches.0", "2/2", item=-1)),
    ),
    "stereonet_8x": Case(
        parameters=624_644,
        golden=Golden("stereonet_8x", norm=(0.5, 0.8), taps=STEREONET),
        loss="robust",
    ),
    "stereonet_16x": Case(
        parameters=763_109,
        golden=Golden("stereonet_16x", norm=(0.5, 0.8), taps=STEREONET),
        loss="robust",
    ),
    "pdsnet": Case(
        parameters=2_217_717,
        golden=Golden(
            "pdsnet",
            norm=(0.8, 1.2),
            taps={"signatures": Tap("cost", "4/2/2"), "similarity": Tap("aggregation", "4/4", item=-1)},
        ),
        loss="laplace_cross_entropy",
        size=(128, 128),
    ),
    "mobilestereonet_2d": Case(
        parameters=2_352_706,
        training_only=124_704,
        golden=Golden(
            "mobilestereonet2d",
            norm=(0.6, 0.9),
            taps={"volume": Tap("cost"), "head3": Tap("aggregation", item=-1)},
        ),
        # its heads are as wide as there are planes
        max_disparity=192,
        rounding=0.1,
    ),
    "mobilestereonet_3d": Case(
        parameters=1_855_608,
        training_only=85_728,
        golden=Golden(
            "mobilestereonet3d",
            norm=(0.65, 0.95),
            taps={"volume": Tap("cost", "6/4/4"), "head3": Tap("aggregation", "2/2/2", item=-1)},
            logits=1e-3,
        ),
        # float32 is that far from float64 with random weights
        rounding=0.5,
    ),
    "fast_acvnet": Case(
        parameters=3_075_359,
        golden=Golden(
            "fast_acvnet",
            norm=(0.8, 1.2),
            taps={
                "volume8": Tap("attention.cost", "2/2/2", sign=1 / 8),
                "attention": Tap("attention.aggregation.head"),
                "aggregated": Tap("aggregation", item=-1),
            },
            # its features are divided by their norm + 1e-5, ours by 1e-4 at least
            logits=3e-4,
        ),
        max_disparity=ALL_CANDIDATES,
        # one cell whose best two tie reaches nine cells by superpixels
        size=(96, 160),
    ),
    "fast_acvnet_plus": Case(
        parameters=3_203_289,
        golden=Golden(
            "fast_acvnet_plus",
            norm=(0.8, 1.2),
            seed=3,
            taps={
                "volume4": Tap("attention.cost", "2/2", sign=1 / 48),
                "attention": Tap("attention.aggregation", "2/2", item=-1),
                "aggregated": Tap("aggregation", item=-1),
            },
        ),
        max_disparity=ALL_CANDIDATES,
        # one cell whose best two tie reaches nine cells by superpixels
        size=(96, 160),
    ),
    "aanet": _aanet("aanet", 4_002_956, size=(60, 96)),
    "aanet_plus": _aanet("aanetplus", 8_514_130, size=(96, 96)),
    "dispnetc": Case(
        parameters=42_429_110,
        golden=Golden(
            "dispnetcorr1d",
            norm=(1.0, 1.0),  # it has none
            seed=2,
            taps={
                "correlation": Tap("correlation", "2/2"),
                "predict6": Tap("decoder.predict", sign=-1),
                "predict2": Tap("decoder.levels.1.predict", sign=-1),
                "predict1": Tap("decoder.levels.0.predict", sign=-1),
            },
            overrides={"mean": IMAGENET_MEAN, "std": IMAGENET_STD},
        ),
        loss="l1",
        size=(64, 128),
    ),
    "hd3s": _hd3("hd3s", 38_651_692, 0.4),
    "hd3sc": _hd3("hd3sc", 39_055_020, 0.45),
    "crl": Case(parameters=78_765_599, golden=CAFFE, loss="l1", size=(64, 128)),
    # its classifier of 4,883 weights is left out
    "segstereo": Case(
        parameters=60_803_252 - 4_883,
        golden=CAFFE,
        loss="l1",
        rounding=0.3,  # with random weights, float32 and float64 differ by 0.02 px in the mean
    ),
    "resnetcorr": Case(parameters=37_214_369, golden=CAFFE, loss="l1"),
    # whole candidates jump where rounding moves them across
    "deeppruner_best": Case(
        parameters=7_390_142, golden=NOT_COMMERCIAL, loss="quantile", max_disparity=48, size=(64, 96), rounding=0.5
    ),
    "deeppruner_fast": Case(
        parameters=7_469_646, golden=NOT_COMMERCIAL, loss="quantile", max_disparity=96, size=(64, 128), rounding=0.5
    ),
    "raft_stereo": Case(
        parameters=11_116_176,
        golden=_raft("raft_stereo", "2/2", levels=3),
        loss="l1",
        overrides={"iterations": 2, "test_iterations": 2},
    ),
    # of the published 9,865,568 never read ones are left out
    "raft_stereo_realtime": Case(
        parameters=9_865_568 - 1_788_416,
        golden=_raft("raft_stereo_realtime", "1/1", levels=2),
        loss="l1",
        overrides={"iterations": 2, "test_iterations": 2},
        size=(64, 128),
    ),
    # of each, the 16 weights of a norm that is never read are left out
    "rt_igev": Case(
        parameters=4_165_162 - 16,
        training_only=84_297,
        golden=Golden(
            "rt_igev",
            norm=(0.8, 1.2),
            taps={
                "geometry": Tap("geometry", "4/4"),
                "logits": Tap("classifier", "4/4"),
                "lookup_1": Tap("lookup", "4/4"),
                "hidden1": Tap("update.units.0", "8/2/2"),
                "mask_feature": Tap("superpixels.stem", "4/4"),
            },
            overrides={"test_iterations": 4},
            logits=5e-4,
        ),
        loss="sequence",
        overrides={"iterations": 2, "test_iterations": 2},
    ),
    "igev": Case(
        parameters=12_598_114 - 16,
        training_only=84_297,
        golden=Golden(
            "igev",
            norm=(0.6, 0.8),
            taps={
                "volume": Tap("geometry.stem_guidance", "2/1/4/4"),
                "geometry": Tap("geometry", "2/1/4/4"),
                "logits": Tap("classifier", "4/4"),
                "lookup_1_geometry": Tap("lookup", "4/4"),
                "lookup_1_pairs": Tap("pair_lookup", "4/4"),
                "hidden1_0": Tap("update.units.0", "8/2/2"),
                "hidden1_1": Tap("update.units.1", "8/2/2"),
                "hidden1_2": Tap("update.units.2", "8/1/1"),
                "mask_feature": Tap("superpixels.stem", "4/4"),
            },
            overrides={"test_iterations": 4},
            logits=5e-4,
        ),
        loss="sequence",
        overrides={"iterations": 2, "test_iterations": 2},
    ),
}


def captured(model: nn.Module, taps: Mapping[str, Tap], run: Any) -> dict[str, Tensor]:
    """What the taps read in one pass; of a module that is called several times, the first."""
    found: dict[str, Tensor] = {}
    handles = []
    for name, tap in taps.items():

        def keep(_module: nn.Module, _inputs: Any, output: Any, name: str = name, tap: Tap = tap) -> None:
            found.setdefault(name, tap.read(output))

        handles.append(model.get_submodule(tap.module).register_forward_hook(keep))
    try:
        run()
    finally:
        for handle in handles:
            handle.remove()
    return found
