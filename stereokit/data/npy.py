"""Disparity in NumPy's files, read without ever unpickling and without trusting the header's size."""

import ast
import io
import math
import os
import zipfile
import zlib
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import (
    Disparity,
    PathLike,
    check_claimed_size,
    to_disparity,
    unknown_to_nan,
)
from stereokit.data.images import read_file_bytes
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = ["NPY_MAGIC", "read_npy", "read_npz", "write_npy", "write_npz"]

NPY_MAGIC = b"\x93NUMPY"
_HEADER_LIMIT = 4096
_BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, OSError, ValueError)


def read_npy(path: PathLike) -> Disparity:
    """Reads a disparity map from a .npy file.

    Returns:
        (H, W) float32, NaN where the file holds NaN or an infinite value.

    Raises:
        InputError: a missing, malformed, truncated or too large file, or an array that is not (H, W) of
            numbers.
    """
    return _read_stream(path, io.BytesIO(read_file_bytes(path)))


def write_npy(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map as float32 .npy, unknown as NaN.

    Raises:
        InputError: `disparity` is not (H, W), or the file can't be written.
    """
    values = to_disparity(path, disparity)
    with atomic_path(path, overwrite=overwrite) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)


def read_npz(path: PathLike) -> Disparity:
    """Reads a disparity map from a .npz file that holds one array, or one named "disparity".

    Returns:
        (H, W) float32, NaN where the file holds NaN or an infinite value.

    Raises:
        InputError: a missing, malformed, truncated or too large file, several arrays none of which is
            "disparity", or an array that is not (H, W) of numbers.
    """
    name = os.fspath(path)
    try:
        with zipfile.ZipFile(io.BytesIO(read_file_bytes(path))) as archive:
            names = [entry for entry in archive.namelist() if entry.endswith(".npy")]
            chosen = "disparity.npy" if "disparity.npy" in names else names[0] if len(names) == 1 else None
            if chosen is None:
                keys = ", ".join(repr(entry[:-4][:40]) for entry in names[:8]) or "no arrays"
                raise InputError(f"{name!r} holds {keys}; expected one array, or one named 'disparity'")
            with archive.open(chosen) as file:
                return _read_stream(path, file)
    except InputError:
        raise
    except _BROKEN_ZIP as error:
        raise InputError(f"{name!r} is a broken npz: {error}") from error


def write_npz(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map as a compressed .npz with the float32 array "disparity", unknown as NaN.

    Raises:
        InputError: `disparity` is not (H, W), or the file can't be written.
    """
    values = to_disparity(path, disparity)
    with atomic_path(path, overwrite=overwrite) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, disparity=values)


def _read_stream(path: PathLike, file: IO[bytes]) -> Disparity:
    """Reads an array after checking its header, which decides how much memory is reserved."""
    name = os.fspath(path)
    try:
        shape, fortran_order, dtype = _read_header(file)
    except (ValueError, TypeError, KeyError, SyntaxError, MemoryError, RecursionError) as error:
        raise InputError(f"{name!r} is a broken npy: {(str(error) or repr(error)).splitlines()[0]}") from error
    if dtype.kind not in "fiu" or len(shape) != 2:
        raise InputError(f"{name!r} holds {dtype} of shape {shape}; expected real numbers of shape (H, W)")
    check_claimed_size(path, shape)
    expected = math.prod(shape) * dtype.itemsize
    data = file.read(expected)
    if len(data) < expected:
        raise InputError(f"{name!r} is truncated: {expected} bytes of data announced, {len(data)} there")
    return unknown_to_nan(np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C"))


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type, which `numpy.lib.format` writes as magic, version, length and a literal."""
    start = file.read(8)
    if start[:6] != NPY_MAGIC or start[6:7] not in (b"\1", b"\2", b"\3"):
        raise ValueError("it does not begin as one of version 1 to 3 does")
    length = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    if length > _HEADER_LIMIT:
        raise ValueError(f"its header claims {length} bytes")
    header = ast.literal_eval(file.read(length).decode("utf-8").strip())
    shape, dtype = header["shape"], np.dtype(header["descr"])
    if not (isinstance(shape, tuple) and all(isinstance(side, int) for side in shape)):
        raise ValueError("its shape is not made of whole numbers")
    return shape, bool(header["fortran_order"]), dtype
