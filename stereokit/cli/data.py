"""`stereokit data check`."""

import argparse

from tqdm import tqdm

from stereokit.data.datasets import DATASETS, check_dataset, format_report, open_dataset
from stereokit.errors import InputError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit data`."""
    jobs = parser.add_subparsers(dest="job", required=True, metavar="JOB")
    check = jobs.add_parser("check", help="read everything once; report counts, sizes, disparity and broken files")
    check.add_argument("kind", metavar="KIND", help=f"{', '.join(DATASETS.names())}; KIND/SPLIT names a part")
    check.add_argument("root", metavar="ROOT", help="folder or list file of the data set")


def run(options: argparse.Namespace) -> None:
    """Reads the data set and prints the report.

    Raises:
        StereoKitError: a data set that can't be opened, or one with broken pairs.
    """
    dataset = open_dataset(f"{options.kind}:{options.root}", allow_missing=True)
    report = check_dataset(dataset, progress=lambda entries: tqdm(entries, total=len(dataset), unit="pair"))
    print(format_report(report))
    if report.broken:
        raise InputError(f"{len(report.broken)} of {report.pairs} pairs are broken")
