"""`stereokit bench`."""

import argparse
import shlex
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import torch
from tqdm import tqdm

from stereokit.bench.candidates import BACKENDS, PRECISIONS, Candidate, rival_source, source_of
from stereokit.bench.report import Benchmark, check_plot
from stereokit.bench.run import run_benchmark
from stereokit.cli.options import DEVICE_HELP, network_help
from stereokit.errors import ConfigError, InputError
from stereokit.evaluation.sgbm import SGBM_VARIANTS
from stereokit.files import check_free
from stereokit.network import MIN_SIZE
from stereokit.registry import list_models, suggest
from stereokit.runtime.device import choose_device

__all__ = ["add_arguments", "run"]

RIVAL_BACKEND = "opencv"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit bench`."""
    backends = [name for name in BACKENDS if name != RIVAL_BACKEND]
    parser.description = (
        "Times networks against each other, in turns, on images that lie on the device already; what copies to and "
        "from it take is not in the times. Weights do not change the speed: a network given by its name is untrained."
    )
    parser.add_argument(
        "models",
        nargs="*",
        metavar="MODEL_OR_WEIGHTS",
        help=f"{network_help(bare_name='untrained')}: {', '.join(list_models())} (default: coex)",
    )
    parser.add_argument("--rival", nargs="+", default=[], metavar="NAME", help=f"{', '.join(SGBM_VARIANTS)}")
    parser.add_argument(
        "--backend", nargs="+", default=["torch"], metavar="NAME", help=f"{', '.join(backends)} (default: torch)"
    )
    parser.add_argument(
        "--precision",
        nargs="+",
        default=["float32"],
        metavar="NAME",
        help=f"{', '.join(PRECISIONS)} (default: float32)",
    )
    parser.add_argument(
        "--size", nargs=2, type=int, action="append", metavar=("H", "W"), help="repeat for several (default: 384 1248)"
    )
    parser.add_argument("--batch", nargs="+", type=int, default=[1], metavar="N", help="pairs at once (default: 1)")
    parser.add_argument(
        "--max-disparity", nargs="+", type=int, default=[None], metavar="D", help="(default: the network's own)"
    )
    parser.add_argument(
        "--iterations",
        nargs="+",
        type=int,
        default=[None],
        metavar="N",
        help="of networks that mend a disparity in rounds (default: the network's own)",
    )
    parser.add_argument("--device", default="auto", help=DEVICE_HELP)
    parser.add_argument("--repeats", type=int, default=20, metavar="N", help="timed runs (default: %(default)s)")
    parser.add_argument("--warmup", type=int, default=3, metavar="N", help="untimed runs before (default: %(default)s)")
    parser.add_argument("--threads", type=int, metavar="N", help="of the CPU (default: as torch and OpenCV choose)")
    parser.add_argument("--stages", action="store_true", help="split torch and eager networks into stages")
    parser.add_argument("--budget", action="store_true", help="measure the hardware's peaks, and the share reached")
    parser.add_argument("--json", metavar="FILE", help="write every time and all that is needed to repeat the run")
    parser.add_argument("--plot", metavar="FILE", help="write a plot, .png, .svg or .pdf (extra: viz)")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")


def run(options: argparse.Namespace) -> None:
    """Times what the options say, prints the tables and writes the files.

    Args:
        options: of `add_arguments`, and `arguments`, the command line that they were parsed from, for the record.

    Raises:
        StereoKitError: options that can't be used; or no candidate could be timed.
    """
    files = [Path(file) for file in (options.json, options.plot) if file is not None]
    check_free(files, overwrite=options.overwrite)
    for file in files:
        # now rather than after minutes of timing
        if not file.parent.is_dir():
            raise InputError(f"{str(file)!r} can't be written: the folder {str(file.parent)!r} does not exist")
    if options.plot is not None:
        check_plot(options.plot)
    candidates = _candidates(options)
    threads = torch.get_num_threads(), cv2.getNumThreads()
    if options.threads is not None:
        if options.threads < 1:
            raise InputError(f"--threads {options.threads}; expected at least 1")
        torch.set_num_threads(options.threads)
        cv2.setNumThreads(options.threads)
    try:
        benchmark = run_benchmark(
            candidates,
            device=choose_device(options.device),
            repeats=options.repeats,
            warmup=options.warmup,
            stages=options.stages,
            budget=options.budget,
            command=shlex.join(["stereokit", *options.arguments]),
            progress=_progress,
        )
    finally:
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])
    if benchmark.failed:
        reasons = "; ".join(dict.fromkeys(f"{row.name} {row.backend}: {row.error}" for row in benchmark.rows))
        raise InputError(f"nothing could be timed: {reasons}")
    print(benchmark)
    _write(benchmark, options)


def _candidates(options: argparse.Namespace) -> list[Candidate]:
    backends = [name for name in BACKENDS if name != RIVAL_BACKEND]
    for option, given, known in (
        ("--backend", options.backend, backends),
        ("--precision", options.precision, list(PRECISIONS)),
    ):
        for name in given:
            if name not in known:
                raise ConfigError(f"{option} {name}: {suggest(name, known)}")
    sizes = options.size or [[384, 1248]]
    for height, width in sizes:
        if min(height, width) < MIN_SIZE:
            raise InputError(f"--size {height} {width} is below {MIN_SIZE} x {MIN_SIZE}, the smallest networks take")
    if min(options.batch) < 1:
        raise InputError(f"--batch {min(options.batch)}; expected at least 1")
    networks = {model: source_of(model) for model in options.models or ([] if options.rival else ["coex"])}
    rivals = {name: rival_source(name) for name in options.rival}
    candidates = []
    for (height, width), batch, max_disparity in product(sizes, options.batch, options.max_disparity):
        place: dict[str, Any] = {
            "height": height,
            "width": width,
            "batch": batch,
            "max_disparity": max_disparity,
        }
        candidates += [
            Candidate(_name(model), source, backend, precision, iterations=iterations, **place)
            for (model, source), backend, precision, iterations in product(
                networks.items(), options.backend, options.precision, options.iterations
            )
        ]
        candidates += [Candidate(name, source, RIVAL_BACKEND, "uint8", **place) for name, source in rivals.items()]
    return candidates


def _name(model: str) -> str:
    return Path(model).name or model


def _write(benchmark: Benchmark, options: argparse.Namespace) -> None:
    if options.json is not None:
        benchmark.save(options.json, overwrite=options.overwrite)
        print(f"\nwrote {options.json}")
    if options.plot is not None:
        benchmark.save_plot(options.plot, overwrite=options.overwrite)
        print(f"\nwrote {options.plot}")


def _progress(steps: Iterable[Any]) -> Iterable[Any]:
    # nothing where the output is a file
    return tqdm(steps, leave=False, disable=None)
