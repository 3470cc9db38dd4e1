"""`stereokit eval`."""

import argparse
import importlib
import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from stereokit.cli.loading import find_chosen_network, load_predictor
from stereokit.cli.options import add_bit_depth_option, add_predictor_options, add_published_options, network_help
from stereokit.data.datasets.dataset import StereoEntry
from stereokit.data.datasets.opening import open_dataset
from stereokit.errors import ConfigError, InputError, printable
from stereokit.evaluation.evaluate import Observer, evaluate
from stereokit.evaluation.matcher import Matcher, NetworkMatcher
from stereokit.evaluation.report import Report
from stereokit.evaluation.results import PairLog, result_paths
from stereokit.evaluation.sgbm import SGBM_VARIANTS
from stereokit.evaluation.submission import KittiSubmission
from stereokit.evaluation.tables import format_dataset
from stereokit.files import check_folder, check_free
from stereokit.registry import list_models, suggest

__all__ = ["add_arguments", "run"]

NETWORK_OPTIONS = ("precision", "max_memory", "too_large", "scale", "iterations")
"""Which have no meaning for a matcher of another kind."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit eval`."""
    parser.add_argument(
        "--model",
        help=f"a network ({', '.join(list_models())}); OpenCV's semi-global matcher with 8 paths (sgbm) or 5 "
        "(sgbm_5paths), holes filled from the background, or left (sgbm_unfilled, sgbm_5paths_unfilled); or a "
        "function of your own, MODULE:FUNCTION, from left and right image to disparity (default: coex)",
    )
    parser.add_argument("--weights", help=f"{network_help(exported=True)} (default: those of --model)")
    add_published_options(parser)
    parser.add_argument(
        "--data",
        action="append",
        required=True,
        metavar="KIND[/SPLIT][,OPTION=VALUE]:ROOT",
        help="data set, such as kitti2012:/data/kitti2012; may be given several times",
    )
    parser.add_argument("--limit", type=int, metavar="N", help="only the first N pairs of each data set")
    add_predictor_options(parser)
    add_bit_depth_option(parser)
    parser.add_argument(
        "--batch", type=int, default=1, metavar="N", help="match N pairs of equal size at once (default: 1)"
    )
    parser.add_argument(
        "--max-disparity",
        type=float,
        metavar="D",
        help="count only pixels whose ground truth is below D px (default: all; SceneFlow is customarily below 192)",
    )
    parser.add_argument(
        "--search-range", type=int, metavar="D", help="disparities that sgbm tries, 0 to D - 1 (default: 192)"
    )
    parser.add_argument("--out", default="evaluation", help="folder for JSON and CSV (default: %(default)s)")
    parser.add_argument("--report", metavar="DIR", help="write DIR/index.html, with pictures of the pairs, worst first")
    parser.add_argument(
        "--report-pairs", type=int, default=100, metavar="N", help="pictures of N pairs per data set (default: 100)"
    )
    parser.add_argument("--submission", metavar="DIR", help="write disparity as KITTI's test server takes it")
    parser.add_argument("--overwrite", action="store_true", help="replace existing results")


def run(options: argparse.Namespace) -> None:
    """Evaluates as the options say, prints a table per data set and writes the files.

    Args:
        options: of `add_arguments`, and `arguments`, the command line that they were parsed from, for the record.

    Raises:
        StereoKitError: options or data that can't be used; then no result is written.
    """
    for folder in (options.out, options.report, options.submission):
        # now rather than after hours of matching
        if folder is not None:
            check_folder(folder)
    check_free(result_paths(options.out), overwrite=options.overwrite)
    if len(set(options.data)) < len(options.data):
        raise InputError(f"--data names {', '.join(options.data)}; expected each once")
    datasets = {spec: open_dataset(spec, bit_depth=options.bit_depth) for spec in options.data}
    for spec, dataset in datasets.items():
        if options.submission is None and not any(entry.disparity for entry in dataset.entries):
            raise InputError(f"{spec!r} has no ground truth, split {dataset.split!r}: there is nothing to count")
    log = PairLog(options.out)
    observers: list[Observer] = [log]
    report = None
    if options.report is not None:
        report = Report(
            options.report,
            most=options.report_pairs,
            overwrite=options.overwrite,
            min_disparity=options.min_disparity or 0,
        )
        observers.append(report)
    if options.submission is not None:
        if len(datasets) > 1:
            raise InputError(f"--submission takes one data set, kitti2012 or kitti2015; got {len(datasets)}")
        [dataset] = datasets.values()
        observers.append(KittiSubmission(options.submission, dataset, overwrite=options.overwrite))
    matcher = _matcher(options)
    if log.path.exists():
        print(f"replacing {printable(log.path)}, which an evaluation left that did not end", file=sys.stderr)
    evaluation = evaluate(
        matcher,
        datasets,
        limit=options.limit,
        max_disparity=options.max_disparity,
        min_disparity=options.min_disparity or 0,
        batch=options.batch,
        observers=observers,
        progress=_progress,
        command=shlex.join(["stereokit", *options.arguments]),
    )
    for result in evaluation.datasets:
        print(format_dataset(result, evaluation.settings["taus"]), end="\n\n")
    written = [
        *evaluation.save(options.out, overwrite=options.overwrite),
        *([report.save(evaluation)] if report else []),
    ]
    log.finish()
    print(f"wrote {', '.join(printable(path, quoted=False) for path in written)}")
    if options.submission is not None:
        print(f"wrote {len(evaluation.datasets[0].pairs)} disparity maps into {options.submission}; zip its content")


def _matcher(options: argparse.Namespace) -> Matcher:
    name = options.model or "coex"
    if name in SGBM_VARIANTS or ":" in name:
        _refuse(name, options, "weights", "channel_order", "top_k", *NETWORK_OPTIONS)
        if options.device not in ("auto", "cpu"):
            raise ConfigError(f"--model {name} does not run on a device of torch; leave out --device {options.device}")
        if options.backend != "auto":
            raise ConfigError(f"--model {name} has no backends; leave out --backend {options.backend}")
    if ":" in name:
        _refuse(name, options, "search_range")
        return _own_function(name)
    if name in SGBM_VARIANTS:
        given = {
            name: value for name in ("search_range", "min_disparity") if (value := getattr(options, name)) is not None
        }
        return replace(SGBM_VARIANTS[name], **given)
    if name not in list_models():
        raise ConfigError(f"unknown model {name!r}; {suggest(name, [*list_models(), *SGBM_VARIANTS])}")
    _refuse(name, options, "search_range")
    return NetworkMatcher(load_predictor(options), weights=find_chosen_network(options))


def _refuse(name: str, options: argparse.Namespace, *given: str) -> None:
    """An option without a meaning for this model is an error, not ignored."""
    for option in given:
        if getattr(options, option) is not None:
            raise ConfigError(f"--model {name} takes no --{option.replace('_', '-')}; leave it out")


def _own_function(name: str) -> Matcher:
    module_name, _, attribute = name.partition(":")
    # as `python -m` does, so that a file beside the user is found
    sys.path.insert(0, os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except (ImportError, ValueError) as error:
        raise ConfigError(f"--model {name}: the module {module_name!r} can't be imported: {error}") from error
    finally:
        sys.path.pop(0)
    function: Any = getattr(module, attribute, None)
    if not callable(function):
        raise ConfigError(f"--model {name}: {module_name} has no function {attribute!r}")
    return function


def _progress(entries: Sequence[StereoEntry], name: str) -> Iterable[StereoEntry]:
    return tqdm(entries, desc=Path(name).name or name, unit="pair")
