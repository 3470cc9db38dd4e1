"""Pairs a second of many pairs of files: one after the other, beside threads, in processes, and the network's own rate.

    python benchmarks/batch_rate.py
    python benchmarks/batch_rate.py --pairs 40 --part 10 --rounds 2 --processes 2

Renders pairs as PNG, then matches them part by part. Each part is matched by every form before the next part comes, so
that what else runs on the machine disturbs all of them alike; their order turns from part to part. Each form has a
process of its own, which is made ready before the clock starts. "one after the other" reads, matches and writes a pair
before the next one; "network alone" has its images in memory and writes nothing.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch

from stereokit import Predictor
from stereokit.batch import match_files
from stereokit.data import write_image
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import match_pairs
from stereokit.data.synthetic import SyntheticScenes
from stereokit.optimize import keep_freed_memory

SERIAL, THREADS, PROCESSES, NETWORK = "one after the other", "threads", "processes", "network alone"


def open_predictor(weights: str, default: str, device: str | None) -> Predictor:
    return Predictor(weights, device=device or default)


def render(folder: Path, options: argparse.Namespace) -> None:
    """Writes the pairs that are not there yet."""
    height, width = options.size
    scenes = SyntheticScenes(size=(height, width), max_disparity=min(96, width // 4), count=options.pairs)
    for view in ("left", "right"):
        (folder / view).mkdir(parents=True, exist_ok=True)
    for i in range(options.pairs):
        if not (folder / "right" / f"{i:04}.png").exists():
            scene = scenes[i]
            for view in ("left", "right"):
                write_image(folder / view / f"{i:04}.png", getattr(scene, view), overwrite=True)


def serve(options: argparse.Namespace) -> None:
    """One form: for each line of input, the first and the last pair of a part, prints its seconds and busy share."""
    keep_freed_memory()
    pairs = match_pairs(Path(options.folder) / "left", Path(options.folder) / "right")
    opening = partial(open_predictor, options.weights, options.device)
    predictor = opening(None)
    predictor(pairs[0].left, pairs[0].right)
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        first, last = json.loads(line)
        part = pairs[first:last]
        if options.form == NETWORK:
            views = [to_pair(pair.left, pair.right) for pair in part]
            start = time.perf_counter()
            network = sum(predictor(*view).seconds for view in views)
            seconds, busy = time.perf_counter() - start, network / (time.perf_counter() - start)
        else:
            with tempfile.TemporaryDirectory(dir=options.folder) as out:
                how = {"workers": 0 if options.form == SERIAL else options.workers}
                if options.form == PROCESSES:
                    how["processes"] = options.processes
                summary = match_files(part, opening if options.form == PROCESSES else predictor, out, **how)
            seconds, busy = summary.seconds, summary.busy
        print(json.dumps([seconds, busy]), flush=True)


def compare(options: argparse.Namespace) -> None:
    forms = [form for form in (SERIAL, THREADS, PROCESSES, NETWORK) if form not in options.skip]
    load = os.getloadavg()[0]
    print(f"{options.pairs} pairs of {options.size[1]} x {options.size[0]}, {options.weights}, ", end="")
    print(f"{multiprocessing.cpu_count()} cores, torch {torch.__version__}, load {load:.1f}")
    render(Path(options.folder), options)
    servers = {}
    for form in forms:
        command = [sys.executable, *sys.argv, "--folder", options.folder, "--form", form]
        servers[form] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        servers[form].stdout.readline()
    rates: dict[str, list[tuple[float, float]]] = {form: [] for form in forms}
    starts = list(range(0, options.pairs, options.part))[: options.rounds]
    for turn, first in enumerate(starts):
        last = min(first + options.part, options.pairs)
        for i in range(len(forms)):
            form = forms[(i + turn) % len(forms)]
            servers[form].stdin.write(json.dumps([first, last]) + "\n")
            servers[form].stdin.flush()
            seconds, busy = json.loads(servers[form].stdout.readline())
            rates[form].append(((last - first) / seconds, busy))
    for server in servers.values():
        server.stdin.close()
        server.wait()
    print(f"{len(starts)} parts of {options.part} pairs each, load at the end {os.getloadavg()[0]:.1f}\n")
    print("| form | pairs a second, median | of one after the other | network busy |")
    print("| --- | ---: | ---: | ---: |")
    for form in forms:
        rate, busy = np.median(rates[form], axis=0)
        ratio = np.median([a[0] / b[0] for a, b in zip(rates[form], rates[forms[0]], strict=True)])
        print(f"| {form} | {rate:.2f} | {ratio:.2f} | {100 * busy:.0f} % |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--size", nargs=2, type=int, default=(375, 450), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--part", type=int, default=20, help="pairs that each form matches at a time")
    parser.add_argument("--rounds", type=int, help="parts at most (default: all)")
    parser.add_argument("--weights", default="coex")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--skip", action="append", default=[], help="a form that is left out; repeat")
    parser.add_argument("--folder", help="for the pairs, rendered where they are not there (default: temporary)")
    parser.add_argument("--form", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.form:
        serve(options)
    elif options.folder:
        compare(options)
    else:
        with tempfile.TemporaryDirectory() as options.folder:
            compare(options)


if __name__ == "__main__":
    main()
