"""The `stereokit` command: one thin function per job."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args

import numpy as np
from tqdm import tqdm

from stereokit._version import __version__
from stereokit.backends import BACKENDS
from stereokit.bench.summary import model_summary
from stereokit.builder import build_model
from stereokit.cli import bench as benchmark_command
from stereokit.cli import eval as evaluation_command
from stereokit.cli import export as export_command
from stereokit.cli import train as training_command
from stereokit.cli.synth import run_synth
from stereokit.data.datasets import DATASETS, check_dataset, format_report, open_dataset
from stereokit.data.pairs import match_pairs
from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError
from stereokit.files import check_folder, check_free
from stereokit.inference import Predictor, output_paths
from stereokit.inference.bounds import TooLarge
from stereokit.network import MIN_SIZE, StereoNetwork
from stereokit.optimize import keep_freed_memory
from stereokit.registry import MODELS, REGISTRIES, list_components
from stereokit.runtime.precision import DTYPES
from stereokit.weights import default_weights, load_weights, named_weights, read_manifest, suggest_weights
from stereokit.weights.folder import CONFIG_NAME, WEIGHTS_NAME
from stereokit.weights.places import is_exported
from stereokit.weights.published import ConversionReport, convert_published, published_networks

__all__ = ["main"]


PRECISION_HELP = f"{', '.join(DTYPES)} for the arithmetic (default: float32, or that of an exported file)"
BACKEND_HELP = f"{', '.join(BACKENDS)} (default: torch, or that of an exported file)"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Bad usage is one line, as every other error."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: without the program's name; those of the process by default.

    Returns:
        The exit code: 0, or 2 with one line on standard error.

    >>> main(["list", "costs"])
    concatenation
    correlation
    groupwise_correlation
    0
    """
    if arguments is None:
        # the process is this command's own
        keep_freed_memory()
    given = sys.argv[1:] if arguments is None else list(arguments)
    options, unknown = _parser().parse_known_args(given, argparse.Namespace(arguments=given))
    if unknown:
        _refuse(options.command, unknown)
    try:
        options.run(options)
    except StereoKitError as error:
        print(f"stereokit {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _refuse(command: str, unknown: Sequence[str]) -> NoReturn:
    """What argparse says of arguments that a command does not know, which names no command."""
    unquoted = not unknown[0].startswith("-")
    hint = " (a pattern such as 'left/*.png' must stand in quotes)" if unquoted else ""
    print(
        f"stereokit {command}: unrecognized arguments: {' '.join(unknown)}{hint}; see stereokit {command} --help",
        file=sys.stderr,
    )
    raise SystemExit(2)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="stereokit", description="Stereo matching: disparity maps from rectified pairs of images.")
    parser.add_argument("--version", action="version", version=f"stereokit {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    predict = commands.add_parser("predict", help="turn a rectified pair, or many, into disparity maps")
    predict.add_argument("left", help="left image, folder, or quoted pattern")
    predict.add_argument("right", help="right image, folder, or quoted pattern")
    predict.add_argument("--model", help="name of the network that the weights are for (default: coex)")
    predict.add_argument(
        "--weights",
        help="folder of a saved network, published checkpoint, exported file, a name of stereokit list weights, or "
        "that of a network for its default ones",
    )
    _add_published_options(predict)
    predict.add_argument("--out", default="disparity", help="folder for the results (default: %(default)s)")
    predict.add_argument("--device", default="auto", help="cpu, cuda, .. (default: a GPU if there is one)")
    predict.add_argument("--backend", default="auto", help=BACKEND_HELP)
    predict.add_argument("--precision", metavar="NAME", help=PRECISION_HELP)
    _add_limits(predict)
    predict.add_argument("--overwrite", action="store_true", help="replace existing results")
    predict.set_defaults(run=_predict)

    evaluation = commands.add_parser("eval", help="count errors on data sets with ground truth")
    evaluation_command.add_arguments(evaluation)
    evaluation.add_argument("--precision", metavar="NAME", help=PRECISION_HELP)
    _add_limits(evaluation)
    _add_published_options(evaluation)
    evaluation.set_defaults(run=lambda options: evaluation_command.run(options, _load_predictor))

    export = commands.add_parser("export", help="write a network as ONNX, OpenVINO or torch.export file, and check it")
    export_command.add_arguments(export)
    _add_published_options(export)
    export.set_defaults(run=lambda options: export_command.run(options, _load_network))

    training = commands.add_parser("train", help="train a network by a recipe")
    training_command.add_arguments(training)
    _add_published_options(training)
    training.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="time networks, backends and sizes against each other")
    benchmark_command.add_arguments(bench)
    bench.set_defaults(run=benchmark_command.run)

    data = commands.add_parser("data", help="look at a data set on disk")
    jobs = data.add_subparsers(dest="job", required=True, metavar="JOB")
    check = jobs.add_parser("check", help="read everything once; report counts, sizes, disparity and broken files")
    check.add_argument("kind", metavar="KIND", help=f"{', '.join(DATASETS.names())}; KIND/SPLIT names a part")
    check.add_argument("root", metavar="ROOT", help="folder or list file of the data set")
    check.set_defaults(run=_check_data)

    listing = commands.add_parser("list", help="list networks and components")
    listing.add_argument("slot", nargs="?", metavar="SLOT", help=f"one of {', '.join(REGISTRIES)} (default: all)")
    listing.add_argument("pattern", nargs="?", default="*", metavar="PATTERN", help="such as 'psm*', in quotes")
    listing.set_defaults(run=_list)

    info = commands.add_parser("info", help="parameters and multiply-adds of a network, block by block")
    info.add_argument("model", help="name of a network, or folder of a saved one")
    info.add_argument("--size", nargs=2, type=int, default=(384, 1248), metavar=("HEIGHT", "WIDTH"))
    info.set_defaults(run=_info)

    convert = commands.add_parser("convert", help="turn a published checkpoint into a saved network")
    convert.add_argument("checkpoint", help="Lightning checkpoint or bare state dict")
    convert.add_argument("out", help="folder for the network")
    convert.add_argument("--model", default="coex", help=f"{' or '.join(published_networks())} (default: %(default)s)")
    _add_published_options(convert)
    convert.add_argument("--overwrite", action="store_true", help="replace an existing network")
    convert.set_defaults(run=_convert)

    synth = commands.add_parser("synth", help="render synthetic pairs with ground truth, in SceneFlow's layout")
    synth.add_argument("--count", type=int, required=True, help="number of pairs")
    synth.add_argument("--out", required=True, help="folder for them")
    synth.add_argument("--seed", type=int, default=0, help="of all that is random (default: %(default)s)")
    synth.add_argument("--recipe", help="scenes as this one of stereokit train renders them, such as synthetic")
    synth.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="(default: 256 512, or the recipe's)"
    )
    synth.add_argument("--max-disparity", type=float, help="in pixels (default: 96, or the recipe's)")
    synth.add_argument("--textures", metavar="DIR", help="folder of photographs to use besides procedural textures")
    synth.add_argument("--split", choices=("test", "train"), default="test", help="(default: %(default)s)")
    synth.set_defaults(run=run_synth)
    return parser


def _add_published_options(parser: argparse.ArgumentParser) -> None:
    """What the weights of a published checkpoint can't tell."""
    parser.add_argument(
        "--channel-order",
        choices=("bgr", "rgb"),
        help="of the images that a published checkpoint was trained on (default: bgr, as the authors')",
    )
    parser.add_argument("--top-k", type=int, metavar="K", help="candidates that its regression keeps (default: coex 2)")


def _add_limits(parser: argparse.ArgumentParser) -> None:
    """How large pairs are matched, see `Predictor`."""
    parser.add_argument(
        "--max-memory", metavar="SIZE", help="that a pair may take, such as 4GiB (default: what is free)"
    )
    parser.add_argument(
        "--too-large",
        choices=get_args(TooLarge),
        help="what becomes of a pair that needs more: refused (default), matched in tiles, or at a reduced resolution",
    )
    parser.add_argument(
        "--scale",
        type=float,
        help="match at this part of the resolution, at most 8: 0.5 finds disparities twice as large and less detail, 2 "
        "finer detail and disparities half as large (default: 1)",
    )


def _predict(options: argparse.Namespace) -> None:
    pairs = match_pairs(options.left, options.right)
    # now rather than after the first pair is matched
    check_folder(options.out)
    check_free([p for pair in pairs for p in output_paths(options.out, pair.name)], overwrite=options.overwrite)
    predictor = _load_predictor(options)
    failed: list[str] = []
    for pair in tqdm(pairs, unit="pair", disable=len(pairs) == 1):
        try:
            result = predictor(pair.left, pair.right)
            written = result.save_all(options.out, pair.name, overwrite=options.overwrite)
        except InputError as error:
            if len(pairs) == 1:
                raise
            failed.append(pair.name)
            tqdm.write(f"{pair.name}: {error}", file=sys.stderr)
            continue
        height, width = result.size
        low, high = np.nanmin(result.disparity), np.nanmax(result.disparity)
        if result.invalid:
            tqdm.write(f"{pair.name}: {result.invalid} pixels have no finite disparity", file=sys.stderr)
        if result.preparation_seconds >= 0.05:
            tqdm.write(f"{pair.name}: made ready for {width} x {height} px in {result.preparation_seconds:.1f} s")
        tqdm.write(
            f"{pair.name}: {width} x {height} px, disparity {low:.1f} to {high:.1f} px, {result.seconds:.2f} s "
            f"on {predictor.device}; wrote {', '.join(map(str, written))}"
        )
        if len(written) < len(output_paths(options.out, pair.name)):
            tqdm.write(f"{pair.name}: no 16-bit PNG, which holds 0 to 255.996 px")
    if failed:
        raise InputError(f"{len(failed)} of {len(pairs)} pairs could not be matched: {', '.join(failed)}")


def _check_data(options: argparse.Namespace) -> None:
    dataset = open_dataset(f"{options.kind}:{options.root}", allow_missing=True)
    report = check_dataset(dataset, progress=lambda entries: tqdm(entries, total=len(dataset), unit="pair"))
    print(format_report(report))
    if report.broken:
        raise InputError(f"{len(report.broken)} of {report.pairs} pairs are broken")


def _load_predictor(options: argparse.Namespace) -> Predictor:
    names = ("precision", "max_memory", "too_large", "scale")
    settings: dict[str, Any] = {name: given for name in names if (given := getattr(options, name)) is not None}
    if not is_exported(options.weights):
        return Predictor(_load_network(options), options.device, options.backend, **settings)
    if any(value is not None for value in (options.model, options.channel_order, options.top_k)):
        raise ConfigError("an exported file knows its network; leave out --model, --channel-order and --top-k")
    return Predictor(options.weights, options.device, options.backend, **settings)


def _load_network(options: argparse.Namespace) -> StereoNetwork:
    named = None if options.weights is None else named_weights(options.weights)
    if options.weights is None or named is not None:
        return _load_shipped(options, named)
    if is_exported(options.weights):
        raise CheckpointError(f"{options.weights!r} is an exported file; give the network that it was exported from")
    if not os.path.exists(options.weights):
        raise CheckpointError(
            f"the weights {options.weights!r} do not exist; {suggest_weights(options.weights)}; or give the folder "
            "of a saved network or a published checkpoint"
        )
    if os.path.isdir(options.weights):
        if options.channel_order is not None or options.top_k is not None:
            raise ConfigError(
                "--channel-order and --top-k are for published checkpoints; a saved network knows its own"
            )
        model = StereoNetwork.from_pretrained(options.weights)
        name = model.config["name"]
        if options.model not in (None, name):
            raise CheckpointError(f"{options.weights!r} holds a {name}, not a {options.model}; leave out --model")
        return model
    model, report = _read_published(options, options.weights, options.model or "coex")
    order = (options.channel_order or "bgr").upper()
    said = "" if options.channel_order else ", as the authors' are (--channel-order rgb if these are not)"
    print(f"{options.weights}: {report.loaded} tensors, taken to be trained on {order} images{said}")
    return model


def _load_shipped(options: argparse.Namespace, weights: str | None) -> StereoNetwork:
    network = options.model or "coex"
    if weights is None:
        MODELS.get(network)
        try:
            weights = default_weights(network)
        except ConfigError as error:
            raise CheckpointError(f"{error}; give --weights with a saved network or a published checkpoint") from error
    elif options.model not in (None, read_manifest(weights)["network"]["name"]):
        raise CheckpointError(f"{weights!r} are no weights of a {options.model}; leave out --model")
    _refuse_published_options(options)
    return load_weights(weights)


def _refuse_published_options(options: argparse.Namespace) -> None:
    if options.channel_order is not None or options.top_k is not None:
        raise ConfigError("--channel-order and --top-k are for published checkpoints; give --weights with one")


def _train(options: argparse.Namespace) -> None:
    if options.weights is None:
        _refuse_published_options(options)
    training_command.run(options, _load_network)


def _read_published(options: argparse.Namespace, path: str, network: str) -> tuple[StereoNetwork, ConversionReport]:
    overrides = {} if options.top_k is None else {"top_k": options.top_k}
    return convert_published(path, network, options.channel_order or "bgr", **overrides)


def _list(options: argparse.Namespace) -> None:
    if options.slot is not None:
        names = list_components(options.slot, options.pattern)
        if not names:
            raise ConfigError(
                f"no {options.slot} match {options.pattern!r}; there are {', '.join(list_components(options.slot))}"
            )
        print("\n".join(names))
        return
    for slot in REGISTRIES:
        print(f"{slot:13}{'  '.join(list_components(slot))}")


def _info(options: argparse.Namespace) -> None:
    saved = os.path.isdir(options.model)
    model = StereoNetwork.from_pretrained(options.model) if saved else build_model(options.model)
    height, width = options.size
    if min(height, width) < MIN_SIZE:
        raise InputError(f"--size {height} {width} is below {MIN_SIZE} x {MIN_SIZE}, the smallest that networks take")
    blocks = model_summary(model, height, width)
    parameters, multiply_adds = sum(b.parameters for b in blocks), sum(b.multiply_adds for b in blocks)
    config = model.config
    # a network without slots has no place for guidance
    guidance = f", guidance {config['guidance']['name']} ({config['guidance_at']})" if "guidance" in config else ""
    print(f"{config['name']}: max_disparity {model.max_disparity}{guidance}, one pair of {width} x {height} px")
    line = "{:12}  {:22}  {:27}  {:>12}  {:>10}".format
    print(line("slot", "block", "class", "parameters", "GMACs"))
    for block in blocks:
        gmacs = f"{block.multiply_adds / 1e9:.3f}"
        print(line(block.slot, block.name, block.kind, f"{block.parameters:,}", gmacs))
    print(line("total", "", "", f"{parameters:,}", f"{multiply_adds / 1e9:.3f}"))


def _convert(options: argparse.Namespace) -> None:
    check_folder(options.out)
    check_free([Path(options.out) / name for name in (CONFIG_NAME, WEIGHTS_NAME)], overwrite=options.overwrite)
    model, report = _read_published(options, options.checkpoint, options.model)
    model.save_pretrained(options.out)
    order = (options.channel_order or "bgr").upper()
    regression = f"; regression {model.config['regression']}" if "regression" in model.config else ""
    print(f"{report}\nwrote {options.out} (from {order}{regression})")
