"""A data set by its name and place."""

import os
import warnings
from dataclasses import replace
from typing import Any

from stereokit.data.bit_depth import check_bit_depth
from stereokit.data.datasets.dataset import DATASETS, StereoDataset
from stereokit.data.datasets.layout import NoPairs
from stereokit.errors import InputError, StereoKitError, printable

__all__ = ["open_dataset"]


def open_dataset(
    spec: str,
    *,
    split: str | None = None,
    bit_depth: int | str | None = None,
    allow_missing: bool = False,
    **options: Any,
) -> StereoDataset:
    """Opens a data set that lies on disk.

    Args:
        spec: "KIND:ROOT", such as "kitti2012:/data/kitti2012". KIND may carry a split and options, so that a
            command line can say all in one word: "kitti2015/val:ROOT",
            "sceneflow/test,image_pass=cleanpass:ROOT". The kinds are those of `DATASETS`; all of them take bit_depth.
        split: which part, where `spec` does not say. Each kind has its own and a default.
        bit_depth: the bits of the cameras, where 16-bit images hold fewer: 12 for values up to 4095.
        allow_missing: open it although files are missing; reading such a pair then fails.
        **options: of the kind, such as `resolution="Q"` for "middlebury_v3".

    Raises:
        ConfigError: an unknown kind, or an option that it does not take.
        InputError: another tree than the kind's, an unknown split, or files that are missing.

    >>> import pathlib, tempfile
    >>> import numpy as np
    >>> from stereokit.data import write_disparity, write_image
    >>> root = pathlib.Path(tempfile.mkdtemp())
    >>> for view in ("left", "right"):
    ...     write_image(root / f"{view}.png", np.zeros((4, 6, 3), np.uint8))
    >>> write_disparity(root / "disparity.pfm", np.ones((4, 6)))
    >>> dataset = open_dataset(f"folder:{root}")
    >>> len(dataset), dataset[0].disparity.shape
    (1, (4, 6))
    """
    head, colon, root = spec.partition(":")
    if not (colon and head and root):
        raise InputError(
            f"{printable(spec)} names no data set; expected KIND:ROOT, with KIND one of {', '.join(DATASETS.names())}"
        )
    kind, *words = head.split(",")
    kind, slash, given_split = kind.partition("/")
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{printable(spec)}: expected an option as NAME=VALUE, got {printable(word, most=40)}")
        options[key] = value
    bits = _bits(options.pop("bit_depth", bit_depth))
    if slash or split is not None:
        options["split"] = given_split if slash else split
    try:
        dataset: StereoDataset = DATASETS.build(kind, {"root": root, **options})
    except NoPairs as error:
        others = [name for name in DATASETS.names() if name != kind and _opens(name, root)]
        if not others:
            raise
        raise InputError(f"{error}; it can be opened as {' or '.join(others)}") from error
    dataset.entries = tuple(replace(entry, bit_depth=bits) for entry in dataset.entries)
    missing = [] if allow_missing else dataset.missing_files()
    if missing:
        base = dataset.root if dataset.root.is_dir() else dataset.root.parent
        raise InputError(
            f"{kind} in {printable(root)} is not whole: {len(missing)} of its files are missing, "
            f"the first is {printable(os.path.relpath(missing[0], base))}"
        )
    return dataset


def _bits(given: int | str | None) -> int | None:
    bits = int(given) if isinstance(given, str) and given.isascii() and given.isdigit() else given
    if isinstance(bits, str):
        raise InputError(f"bit_depth must be a whole number from 1 to 16, got {printable(bits, most=40)}")
    check_bit_depth(bits)
    return bits


def _opens(kind: str, root: str) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return bool(DATASETS.build(kind, {"root": root}))
        except StereoKitError:
            return False
