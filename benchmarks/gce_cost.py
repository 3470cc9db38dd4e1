"""What guidance costs in time: GCE at one scale and at every scale, addition, and neighbourhood aggregation.

    python benchmarks/gce_cost.py --json gce_cost.json

All are CoEx with top-2, timed in turns. The paper says, on an RTX 2080 Ti: 26 ms without GCE or with it at one scale,
27 at every scale, and 47 with neighbourhood aggregation in its place at one scale, 1.8 times as much. Freed memory is
kept, as the command does it. Random weights: they do not change the speed.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from stereokit import StereoKitError, build_model
from stereokit.bench import Benchmark, Candidate, run_benchmark
from stereokit.bench.candidates import BACKENDS
from stereokit.files import check_free
from stereokit.optimize import keep_freed_memory
from stereokit.runtime.device import choose_device
from stereokit.tables import Table

VARIANTS = {
    # overrides of coex, milliseconds in the paper
    "no guidance": ({"guidance": "none"}, 26),
    "GCE, one scale": ({"guidance": "gce", "guidance_at": "one"}, 26),
    "GCE, every scale": ({"guidance": "gce", "guidance_at": "full"}, 27),
    "addition, every scale": ({"guidance": "addition", "guidance_at": "full"}, None),
    "neighbourhood, one scale": ({"guidance": "neighborhood", "guidance_at": "one"}, 47),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs=2, type=int, default=(384, 1248), metavar=("H", "W"))
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--backend", default="torch", choices=[name for name in BACKENDS if name != "opencv"])
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    height, width = options.size
    try:
        check_free([Path(options.json)] if options.json else [], overwrite=options.overwrite)
        candidates = [
            Candidate(
                name,
                partial(build_model, "coex", **overrides),
                options.backend,
                options.precision,
                height,
                width,
                max_disparity=options.max_disparity,
            )
            for name, (overrides, _) in VARIANTS.items()
        ]
        benchmark = run_benchmark(
            candidates,
            device=choose_device(options.device),
            repeats=options.repeats,
            stages=options.backend in ("torch", "eager"),
            command=" ".join(["python", *sys.argv]),
            progress=tqdm,
        )
        if options.json:
            benchmark.save(options.json, overwrite=options.overwrite)
    except StereoKitError as error:
        print(f"gce_cost: {error}", file=sys.stderr)
        return 2
    print(benchmark)
    print(f"\n{table(benchmark)}")
    return 2 if benchmark.failed else 0


def table(benchmark: Benchmark) -> Table:
    """Beside the paper: the time more than without guidance, and in parts of GCE at one scale."""
    medians = {row.name: row.median_seconds for row in benchmark.rows}
    plain, gce = medians["no guidance"], medians["GCE, one scale"]
    rows = []
    for name, (_, paper) in VARIANTS.items():
        median = medians[name]
        more = "-" if median is None or plain is None else f"{1000 * (median - plain):+.1f}"
        ratio = "-" if median is None or gce is None else f"{median / gce:.2f}"
        published = ("-", "-", "-") if paper is None else (f"{paper}", f"{paper - 26:+d}", f"{paper / 26:.2f}")
        rows.append((name, "-" if median is None else f"{1000 * median:.1f}", more, ratio, *published))
    columns = ("guidance", "median [ms]", "more [ms]", "of GCE", "paper [ms]", "more [ms]", "of GCE")
    return Table(columns, tuple(rows))


if __name__ == "__main__":
    sys.exit(main())
