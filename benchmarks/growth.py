"""How time and memory grow with the pixels and with D.

    python benchmarks/growth.py coex --json growth.json

Each point runs in a process of its own, so that its peak memory is its own, and one that runs out of memory takes no
other with it. Points that the free memory can't hold are not begun, and say so. Freed memory is kept, as the command
does it. Random weights: they do not change the speed.
"""

import argparse
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path

import torch
from tqdm import tqdm

from stereokit import StereoKitError
from stereokit.bench import Benchmark, Candidate, Row, run_benchmark, source_of
from stereokit.files import check_free, write_json
from stereokit.optimize import keep_freed_memory
from stereokit.runtime.device import choose_device
from stereokit.runtime.memory import format_memory
from stereokit.runtime.provenance import machine, versions
from stereokit.tables import Table

MEGAPIXELS = (0.25, 0.5, 1, 2, 4, 8)
LEVELS = (64, 128, 192, 256, 384, 512)
SIZE = (384, 1248)
MULTIPLE = 32


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=["coex"], help="networks (default: coex)")
    parser.add_argument("--megapixels", nargs="*", type=float, default=MEGAPIXELS, help="of 3:4 images, D = 192")
    parser.add_argument("--max-disparity", nargs="*", type=int, default=LEVELS, help="D, at 384 x 1248")
    parser.add_argument("--backend", default="torch")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    try:
        check_free([Path(options.json)] if options.json else [], overwrite=options.overwrite)
        device = str(choose_device(options.device))
        points = list(candidates(options))
        runs = [measure(point, device, options.repeats, options.threads) for point in tqdm(points)]
        if options.json:
            record = {"machine": machine(), "versions": versions(), "runs": [asdict(run) for run in runs]}
            write_json(options.json, record, overwrite=options.overwrite)
    except StereoKitError as error:
        print(f"growth: {error}", file=sys.stderr)
        return 2
    print(runs[0].heading().splitlines()[-1] if runs else "no points")
    print(table([run.rows[0] for run in runs]))
    return 0


def candidates(options: argparse.Namespace) -> list[Candidate]:
    common = {"backend": options.backend, "precision": options.precision}
    found = []
    for model in options.models:
        source = source_of(model)
        for megapixels in options.megapixels:
            height = round((megapixels * 1e6 * 3 / 4) ** 0.5 / MULTIPLE) * MULTIPLE
            width = round(megapixels * 1e6 / height / MULTIPLE) * MULTIPLE
            found.append(Candidate(model, source, height=height, width=width, max_disparity=192, **common))
        found += [
            Candidate(model, source, height=SIZE[0], width=SIZE[1], max_disparity=levels, **common)
            for levels in options.max_disparity
        ]
    return found


def measure(candidate: Candidate, device: str, repeats: int, threads: int) -> Benchmark:
    """The benchmark of one candidate, from a fresh process."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=prepare_process, initargs=(threads,)) as pool:
        try:
            return pool.submit(run_benchmark, [candidate], device=device, repeats=repeats, warmup=2).result()
        except BrokenProcessPool:
            row = Row(
                candidate.name,
                candidate.backend,
                candidate.precision,
                candidate.height,
                candidate.width,
                candidate.batch,
                candidate.max_disparity,
                error="the system ended the process, most likely for want of memory",
            )
            settings = {"device": device, "repeats": repeats, "warmup": 2}
            return Benchmark((row,), None, settings, machine(), versions(), "", (None, None), None)


def prepare_process(threads: int) -> None:
    torch.set_num_threads(threads)
    keep_freed_memory()


def table(rows: list[Row]) -> Table:
    columns = ("network", "size", "Mpx", "D", "median [ms]", "ms per Mpx", "memory", "bytes per pixel")
    cells = []
    for row in rows:
        pixels = row.height * row.width
        place = (row.name, f"{row.height} x {row.width}", f"{pixels / 1e6:.2f}", str(row.max_disparity))
        if row.median_seconds is None:
            cells.append((*place, row.error or "-", "-", "-", "-"))
            continue
        memory = (
            ("-", "-")
            if row.peak_memory is None
            else (format_memory(row.peak_memory), f"{row.peak_memory / pixels:.0f}")
        )
        milliseconds = 1000 * row.median_seconds
        cells.append((*place, f"{milliseconds:.1f}", f"{milliseconds / pixels * 1e6:.0f}", *memory))
    return Table(columns, tuple(cells))


if __name__ == "__main__":
    sys.exit(main())
