"""`stereokit predict`."""

import argparse
import math
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import torch
from tqdm import tqdm

from stereokit.batch import MANIFEST_NAME, MatchedPair, Summary, match_files
from stereokit.cli import video
from stereokit.cli.confidence import noise_warning
from stereokit.cli.depth import DepthFiles, add_depth_options
from stereokit.cli.loading import load_predictor
from stereokit.cli.options import add_bit_depth_option, add_predictor_options, add_published_options, network_help
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import ImagePair, match_pairs
from stereokit.errors import ConfigError, InputError, StereoKitError, printable
from stereokit.files import check_folder, check_free
from stereokit.inference import Predictor, output_paths
from stereokit.inference.predictor import advice
from stereokit.tables import counted, share

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit predict`."""
    parser.add_argument("left", help="left image, folder, quoted pattern, video, or camera:0 and the like")
    parser.add_argument("right", nargs="?", help="the right one; left out where LEFT holds both views (--layout)")
    parser.add_argument("--model", help="name of the network that the weights are of (default: coex)")
    parser.add_argument("--weights", help=f"{network_help(exported=True)} (default: those of --model)")
    add_published_options(parser)
    parser.add_argument("--out", default="disparity", help="folder for the results (default: %(default)s)")
    add_predictor_options(parser)
    add_bit_depth_option(parser)
    add_depth_options(parser)
    video.add_video_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace existing results")
    group = parser.add_argument_group("many pairs", "of folders or patterns; what is done already is not done again")
    group.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="threads that read images, and as many that write results, beside the network (default: 2); with 0 pairs "
        "are read, matched and written one after the other",
    )
    group.add_argument(
        "--processes",
        type=int,
        metavar="N",
        help="that match at once, each with the network and its share of the processor's threads, on GPUs in turn "
        "(default: 1)",
    )


def run(options: argparse.Namespace) -> None:
    """Matches the pairs, or the video, that the options name, and says what was written.

    Raises:
        StereoKitError: options, a network or a single pair that can't be used; of several pairs the others are still
            matched.
    """
    if video.is_video_call(options):
        _refuse_options_for_many(options, "a video")
        if options.bit_depth is not None:
            raise ConfigError("--bit-depth has no effect on a video, which says its bits itself; leave it out")
        if options.min_disparity:
            raise ConfigError("--min-disparity is for images alone, not for a video; leave it out, or give images")
        video.run(options)
        return
    pairs = match_pairs(options.left, options.right)
    # now rather than after the first pair is matched
    check_folder(options.out)
    depth = DepthFiles.of(options)
    if Path(options.left).is_file():
        _predict_one(pairs[0], options, depth)
    else:
        _predict_many(pairs, options, depth)


def _predict_one(pair: ImagePair, options: argparse.Namespace, depth: DepthFiles) -> None:
    _refuse_options_for_many(options, "one pair of files")
    out = Path(options.out)
    paths = output_paths(out, pair.name)
    check_free([*paths, *(out / name for name in depth.names(pair.name))], overwrite=options.overwrite)
    predictor = load_predictor(options, bit_depth=options.bit_depth)
    views = to_pair(pair.left, pair.right, bit_depth=options.bit_depth)
    predictor = predictor.for_read_views()
    result = predictor(*views)
    computed = depth.compute(predictor, *views, result)
    written = result.save_all(out, pair.name, overwrite=options.overwrite)
    _say(
        pair.name,
        written,
        size=result.size,
        disparity=result.known_range or (math.nan, math.nan),
        invalid=result.invalid,
        mean_confidence=result.mean_confidence,
        seconds=result.seconds,
        preparation_seconds=result.preparation_seconds,
        device=str(predictor.device),
        precision=predictor.backend.precision,
        rectified=predictor.rectification is not None,
    )
    for line in depth.write(out, pair.name, result, computed):
        tqdm.write(f"{_shown(pair.name)}: {line}")


def _refuse_options_for_many(options: argparse.Namespace, given: str) -> None:
    for name in ("workers", "processes"):
        if getattr(options, name) is not None:
            raise ConfigError(f"--{name} has no effect on {given}; leave it out, or give folders or patterns")


def _predict_many(pairs: Sequence[ImagePair], options: argparse.Namespace, depth: DepthFiles) -> None:
    processes = 1 if options.processes is None else options.processes
    bar: tqdm | None = None
    with ExitStack() as stack:

        def tell(pair: ImagePair, outcome: MatchedPair | StereoKitError) -> None:
            nonlocal bar
            # not before, so that a refusal is one line
            if bar is None:
                bar = stack.enter_context(tqdm(total=len(pairs), unit="pair", disable=len(pairs) == 1))
            if isinstance(outcome, StereoKitError):
                tqdm.write(f"{_shown(pair.name)}: {outcome}", file=sys.stderr)
            elif not outcome.done_before:
                _say_matched(outcome, options)
            bar.update()

        summary = match_files(
            pairs,
            _Opening(options),
            options.out,
            more=depth,
            workers=2 if options.workers is None else options.workers,
            processes=processes,
            devices=_devices(options.device) if processes > 1 else (),
            overwrite=options.overwrite,
            tell=tell,
        )
    print(_totals(summary, options))
    if summary.failed:
        shown = ", ".join(summary.failed[:10]) + (f" and {len(summary.failed) - 10} more" * (len(summary.failed) > 10))
        raise InputError(f"{len(summary.failed)} of {len(pairs)} pairs could not be matched: {shown}")


def _say_matched(outcome: MatchedPair, options: argparse.Namespace) -> None:
    name, record = outcome.pair.name, outcome.record
    if outcome.again is not None:
        tqdm.write(f"{_shown(name)}: matched again: {outcome.again}")
    own = {path.name for path in output_paths(options.out, name)}
    _say(
        name,
        [Path(options.out) / file for file in record.files if file in own],
        size=record.size or (0, 0),
        disparity=record.disparity or (math.nan, math.nan),
        invalid=outcome.invalid,
        mean_confidence=record.mean_confidence,
        seconds=record.seconds or 0.0,
        preparation_seconds=outcome.preparation_seconds,
        device=record.settings["device"],
        precision=record.settings["precision"],
        rectified=options.rig is not None,
    )
    for line in outcome.notes:
        tqdm.write(f"{_shown(name)}: {line}")


def _say(
    name: str,
    written: Sequence[Path],
    *,
    size: Sequence[int],
    disparity: Sequence[float],
    invalid: int,
    mean_confidence: float | None,
    seconds: float,
    preparation_seconds: float,
    device: str,
    precision: str,
    rectified: bool,
) -> None:
    """What became of a pair, in lines."""
    name = _shown(name)
    height, width = size
    if invalid:
        why = "were not seen by both cameras" if rectified else f"have no finite disparity, {advice(precision, device)}"
        tqdm.write(f"{name}: {invalid} pixels ({share(invalid, height * width)}) {why}", file=sys.stderr)
    if preparation_seconds >= 0.05:
        tqdm.write(f"{name}: made ready for {width} x {height} px in {preparation_seconds:.1f} s")
    tqdm.write(
        f"{name}: {width} x {height} px, disparity {disparity[0]:.1f} to {disparity[1]:.1f} px, {seconds:.2f} s "
        f"on {device}; wrote {', '.join(_shown(path) for path in written)}"
    )
    if len(written) < len(output_paths("", name)):
        tqdm.write(f"{name}: no 16-bit PNG, which holds 0 to 255.996 px")
    if (warning := noise_warning(name, mean_confidence)) is not None:
        tqdm.write(warning, file=sys.stderr)


def _shown(name: str | Path) -> str:
    """A name as a terminal shows it, whatever its characters."""
    return printable(name, most=1000, quoted=False)


def _totals(summary: Summary, options: argparse.Namespace) -> str:
    """A line about all pairs."""
    parts = [f"{counted(summary.matched, 'pair')} matched"]
    if summary.matched:
        parts[0] += (
            f" in {summary.seconds:.1f} s ({summary.rate:.2f} a second, the network busy for "
            f"{100 * summary.busy:.0f} % of the time)"
        )
    if summary.done_before:
        parts.append(f"{counted(summary.done_before, 'pair')} done before")
    if summary.failed:
        parts.append(f"{counted(len(summary.failed), 'pair')} failed")
    return f"{', '.join(parts)}; {Path(options.out) / MANIFEST_NAME} tells of each"


class _Opening:
    """Opens the predictor of the options, in any process."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options

    def __call__(self, device: str | None) -> Predictor:
        options = self.options
        if device is not None:
            options = argparse.Namespace(**{**vars(options), "device": device})
        return load_predictor(options, bit_depth=options.bit_depth)


def _devices(device: str) -> list[str]:
    """The GPUs that processes share out, where no single one is named."""
    if device not in ("auto", "cuda") or not torch.cuda.is_available():
        return []
    return [f"cuda:{i}" for i in range(torch.cuda.device_count())]
