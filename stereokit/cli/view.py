"""`stereokit view`."""

import argparse
import webbrowser
from pathlib import Path
from typing import get_args

from stereokit.calibration import Calibration, read_calibration
from stereokit.cli.loading import check_published_options, load_predictor
from stereokit.cli.options import add_predictor_options, add_published_options, network_help
from stereokit.data.pairs import match_pairs
from stereokit.errors import ConfigError
from stereokit.files import check_free
from stereokit.video import Layout, is_video, open_stereo_video
from stereokit.viewer import Album, Desk, Frames, ViewServer, write_page
from stereokit.viewer.desk import DISPARITY_ERROR
from stereokit.viewer.server import PORT
from stereokit.viewer.sources import find_results

__all__ = ["add_arguments", "run"]

OF_NETWORKS = ("model", "weights", "precision", "max_memory", "too_large", "scale", "rig")
OF_SERVERS = ("host", "port", "open")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit view`."""
    parser.add_argument(
        "left", help="left image, folder, quoted pattern, video, camera:0, or address such as rtsp://..."
    )
    parser.add_argument("right", nargs="?", help="the same of the right view; left out where one video holds both")
    parser.add_argument("--layout", choices=get_args(Layout), help="how one video or camera holds both views")
    parser.add_argument(
        "--disparity", metavar="PLACE", help="show this result, a file or the folder of 'predict', and match nothing"
    )
    parser.add_argument("--calibration", metavar="FILE", help="of the cameras of all pairs; gives metres")
    parser.add_argument("--rig", metavar="FILE", help="of the cameras: their views are rectified first; gives metres")
    parser.add_argument(
        "--disparity-error",
        type=float,
        default=DISPARITY_ERROR,
        metavar="PX",
        help="its standard error, from which that of depth is shown (default: %(default)s)",
    )
    parser.add_argument("--html", metavar="FILE", help="write one page that holds everything, and serve nothing")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing page")
    parser.add_argument("--host", help="address to serve at; others than 127.0.0.1 let other machines look (default)")
    parser.add_argument("--port", type=int, help=f"to serve at, 0 for any that is free (default: {PORT})")
    parser.add_argument("--open", action="store_true", default=None, help="open the page in the browser")
    parser.add_argument("--model", help="name of the network that the weights are of (default: coex)")
    parser.add_argument("--weights", help=f"{network_help(exported=True)} (default: those of --model)")
    add_published_options(parser)
    add_predictor_options(parser)


def run(options: argparse.Namespace) -> None:
    """Serves the page until Ctrl-C, or writes it.

    Raises:
        StereoKitError: options, files or a network that can't be used, or a port that is in use.
    """
    _check(options)
    calibration = None if options.calibration is None else read_calibration(options.calibration)
    if options.layout is None and options.right is not None and not is_video(options.left):
        pairs = match_pairs(options.left, options.right)
        results = None if options.disparity is None else find_results(options.disparity, pairs)
        _show(options, Album(pairs, results), calibration)
        return
    if options.disparity is not None or options.html is not None:
        flag = "--disparity" if options.disparity is not None else "--html"
        raise ConfigError(f"{flag} is for pairs of images, not for a video or a camera; leave it out")
    with open_stereo_video(options.left, options.right, layout=options.layout) as video:
        _show(options, Frames(video, name=video.name, live=video.live), calibration)


def _show(options: argparse.Namespace, source: Album | Frames, calibration: Calibration | None) -> None:
    predictor = None if options.disparity is not None else load_predictor(options)
    desk = Desk(source, predictor, calibration, options.disparity_error)
    try:
        if options.html is not None:
            size = write_page(options.html, desk, overwrite=options.overwrite)
            print(f"wrote {options.html}, {size / 1e6:.1f} MB; open it in a browser")
            return
        # what is wrong with the first pair is said here
        if isinstance(source, Album):
            desk.entry(0)
        else:
            desk.next(-1)
        _serve(desk, options)
    finally:
        desk.close()


def _serve(desk: Desk, options: argparse.Namespace) -> None:
    port = PORT if options.port is None else options.port
    with ViewServer(desk, options.host or "127.0.0.1", port) as server:
        print(f"{server.url} (Ctrl-C ends it)", flush=True)
        if options.open:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()


def _check(options: argparse.Namespace) -> None:
    """Refuses options that have no effect, and a page that is there already."""
    if options.min_disparity:
        raise ConfigError("--min-disparity is not for view, whose distributions begin at 0; leave it out")
    if options.rig is not None and options.calibration is not None:
        raise ConfigError("--calibration has no effect beside --rig, which gives that of the rectified pair")
    if options.html is None and options.overwrite:
        raise ConfigError("--overwrite has no effect without --html; leave it out")
    if options.html is not None:
        given = [name for name in OF_SERVERS if getattr(options, name) is not None]
        if given:
            raise ConfigError(f"--{given[0]} has no effect with --html, which serves nothing; leave it out")
        check_free([Path(options.html)], overwrite=options.overwrite)
    if options.disparity is not None:
        check_published_options(options)
        given = [name for name in OF_NETWORKS if getattr(options, name) is not None]
        given += [name for name in ("device", "backend") if getattr(options, name) != "auto"]
        if given:
            flag = given[0].replace("_", "-")
            raise ConfigError(f"--{flag} has no effect with --disparity, which matches nothing; leave it out")
