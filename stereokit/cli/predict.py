"""`stereokit predict`."""

import argparse
import sys

import numpy as np
from tqdm import tqdm

from stereokit.cli import video
from stereokit.cli.confidence import noise_warning
from stereokit.cli.depth import DepthFiles, add_depth_options
from stereokit.cli.loading import load_predictor
from stereokit.cli.options import add_predictor_options, add_published_options, network_help
from stereokit.data.pairs import ImagePair, match_pairs
from stereokit.errors import InputError
from stereokit.files import check_folder, check_free
from stereokit.inference import Predictor, output_paths

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
    add_depth_options(parser)
    video.add_video_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace existing results")


def run(options: argparse.Namespace) -> None:
    """Matches the pairs, or the video, that the options name, and says what was written.

    Raises:
        StereoKitError: options, a network or a single pair that can't be used; of several pairs the others are still
            matched.
    """
    if video.is_video_call(options):
        video.run(options)
        return
    pairs = match_pairs(options.left, options.right)
    # now rather than after the first pair is matched
    check_folder(options.out)
    depth = DepthFiles.of(options)
    files = [p for pair in pairs for p in (*output_paths(options.out, pair.name), *depth.paths(pair.name))]
    check_free(files, overwrite=options.overwrite)
    predictor = load_predictor(options)
    failed: list[str] = []
    for pair in tqdm(pairs, unit="pair", disable=len(pairs) == 1):
        try:
            _predict(predictor, pair, options, depth)
        except InputError as error:
            if len(pairs) == 1:
                raise
            failed.append(pair.name)
            tqdm.write(f"{pair.name}: {error}", file=sys.stderr)
    if failed:
        raise InputError(f"{len(failed)} of {len(pairs)} pairs could not be matched: {', '.join(failed)}")


def _predict(predictor: Predictor, pair: ImagePair, options: argparse.Namespace, depth: DepthFiles) -> None:
    result = predictor(pair.left, pair.right)
    written = result.save_all(options.out, pair.name, overwrite=options.overwrite)
    height, width = result.size
    low, high = np.nanmin(result.disparity), np.nanmax(result.disparity)
    if result.invalid:
        why = "have no finite disparity" if predictor.rectification is None else "were not seen by both cameras"
        tqdm.write(f"{pair.name}: {result.invalid} pixels {why}", file=sys.stderr)
    if result.preparation_seconds >= 0.05:
        tqdm.write(f"{pair.name}: made ready for {width} x {height} px in {result.preparation_seconds:.1f} s")
    tqdm.write(
        f"{pair.name}: {width} x {height} px, disparity {low:.1f} to {high:.1f} px, {result.seconds:.2f} s "
        f"on {predictor.device}; wrote {', '.join(map(str, written))}"
    )
    if len(written) < len(output_paths(options.out, pair.name)):
        tqdm.write(f"{pair.name}: no 16-bit PNG, which holds 0 to 255.996 px")
    if (warning := noise_warning(pair.name, result)) is not None:
        tqdm.write(warning, file=sys.stderr)
    for line in depth.write(result, pair, predictor):
        tqdm.write(f"{pair.name}: {line}")
