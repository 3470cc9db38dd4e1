"""Evaluates matchers on eleven real pairs and prints one table of their errors.

    python benchmarks/real_pairs.py --weights coex.synthetic_v7
    python benchmarks/real_pairs.py --weights coex.ckpt --channel-order rgb
    python benchmarks/real_pairs.py --weights coex.synthetic_v7 --precision float32 bfloat16
    python benchmarks/real_pairs.py --weights coex.synthetic_v7 --scale 1 1.5 2
    python benchmarks/real_pairs.py --weights coex.synthetic_v7 --weights coex_int8.xml

The scenes are from Middlebury, SceneFlow, ETH3D and KITTI 2012. All pixels with known ground truth count, occluded ones
too. OpenCV's semi-global matcher with 8 and 5 paths, holes filled, stands beside the networks.
"""

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from tqdm import tqdm

from stereokit import StereoKitError, StereoModel, list_weights, load_published
from stereokit.data import read_disparity
from stereokit.data.datasets import Source, StereoDataset, StereoEntry, open_dataset
from stereokit.evaluation import SGBM_VARIANTS, Evaluation, Matcher, NetworkMatcher, evaluate
from stereokit.files import write_json
from stereokit.inference import Predictor
from stereokit.weights.places import is_exported

ROOT = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "real"
MIDDLEBURY = {
    # left, right, truth, stored value of one pixel of disparity
    "Aloe": ("left.png", "right.png", "true_disp.png", 1),
    "Baby": ("left.png", "right.png", "true_disp.png", 1),
    "Cloth3": ("view1.png", "view5.png", "disp1.png", 2),
    "Motorcycle": ("motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz", None),
    "teddy": ("imL.png", "imR.png", "groundtruth.png", 4),
    "tsukuba": ("imL.png", "imR.png", "groundtruth.png", 16),
    "venus": ("imL.png", "imR.png", "groundtruth.png", 8),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", nargs="?", type=Path, default=ROOT, help="folder of the scenes (default: %(default)s)")
    parser.add_argument("--weights", action="append", default=[], help="as stereokit eval takes them; repeat")
    parser.add_argument("--network", default="coex", help="of published checkpoints (default: coex)")
    parser.add_argument("--channel-order", default="bgr", choices=("bgr", "rgb"), help="of published checkpoints")
    parser.add_argument("--device", default="auto")
    parser.add_argument(
        "--precision", nargs="+", default=["float32"], metavar="NAME", help="of networks (default: float32)"
    )
    parser.add_argument("--scale", nargs="+", type=float, default=[1.0], help="at which networks match (default: 1)")
    parser.add_argument("--json", type=Path, help="file for the numbers of the first matcher")
    options = parser.parse_args()
    try:
        scenes = StereoDataset("real pairs", options.root, "all", list(real_pairs(options.root)))
        matchers: dict[str, Matcher] = {}
        for weights in options.weights:
            named = weights in list_weights()
            model: str | StereoModel = weights
            exported = is_exported(weights)
            if not named and not exported and not Path(weights).is_dir():
                model = load_published(weights, options.network, options.channel_order)
            stem = weights if named else Path(weights).stem
            for precision, scale in product([None] if exported else options.precision, options.scale):
                parts = [] if precision in (None, "float32") else [precision]
                parts += [] if scale == 1 else [f"scale {scale:g}"]
                name = ", ".join([stem, *parts])
                predictor = Predictor(model, options.device, precision=precision, scale=scale)
                matchers[", ".join([weights, *parts]) if name in matchers else name] = NetworkMatcher(
                    predictor, weights=weights
                )
        matchers["SGBM, 8 paths"] = SGBM_VARIANTS["sgbm"]
        matchers["SGBM, 5 paths"] = SGBM_VARIANTS["sgbm_5paths"]
        results = {
            name: evaluate(matcher, {name: scenes}, progress=partial(tqdm, leave=False))
            for name, matcher in matchers.items()
        }
    except StereoKitError as error:
        print(f"real_pairs: {error}", file=sys.stderr)
        return 2
    print(table(results))
    if options.json is not None:
        first = numbers(next(iter(results.values())))
        write_json(options.json, first, overwrite=True)
    return 0


def real_pairs(root: Path) -> Iterator[StereoEntry]:
    for name, (left, right, truth, scale) in MIDDLEBURY.items():
        folder = root / "middlebury" / name
        read = partial(read_disparity, scale=scale)
        yield StereoEntry(name, folder / left, folder / right, disparity=Source(folder / truth, read))
    for name, spec in (("SceneFlow", "sceneflow/all"), ("ETH3D", "eth3d"), ("KITTI", "kitti2012")):
        kind = spec.partition("/")[0]
        for entry in open_dataset(f"{spec}:{root / kind}").entries:
            label = f"{name} {Path(entry.name).name}"
            yield StereoEntry(label, entry.left, entry.right, disparity=entry.disparity)


def numbers(evaluation: Evaluation) -> dict[str, Any]:
    model = evaluation.model
    options = {
        "weights": "WEIGHTS" if "weights" in model else None,
        "precision": model["precision"] if model.get("precision", "float32") != "float32" else None,
        "scale": model.get("limits", {}).get("scale"),
    }
    words = [f"--{key} {value}" for key, value in options.items() if value is not None]
    dataset = evaluation.datasets[0]
    return {
        "command": " ".join(["python benchmarks/real_pairs.py SCENES", *words]),
        "mean_bad_3": round(dataset.metrics["bad_3_per_image"], 3),
        "mean_epe": round(dataset.metrics["epe_per_image"], 3),
        "bad_3": {pair.name: round(pair.metrics["bad_3"], 2) for pair in dataset.pairs},
    }


def table(results: dict[str, Evaluation]) -> str:
    datasets = [evaluation.datasets[0] for evaluation in results.values()]
    rows = [["bad-3 [%]", *results], ["---", *["---:" for _ in results]]]
    for pairs in zip(*(d.pairs for d in datasets), strict=True):
        rows.append([pairs[0].name, *(f"{pair.metrics['bad_3']:.1f}" for pair in pairs)])
    rows.append(["**mean bad-3**", *(f"**{d.metrics['bad_3_per_image']:.2f}**" for d in datasets)])
    rows.append(["mean EPE [px]", *(f"{d.metrics['epe_per_image']:.2f}" for d in datasets)])

    rows.append(["median time per pair [s]", *(f"{seconds:.2f}" for seconds in (d.median_seconds for d in datasets))])
    lines = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    first = next(iter(results.values()))
    where = ", ".join([first.machine["processor"], *first.machine["accelerators"]])
    return f"{lines}\n\n{where}, {first.machine['torch_threads']} threads"


if __name__ == "__main__":
    sys.exit(main())
