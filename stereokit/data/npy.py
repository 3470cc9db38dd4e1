"""Disparity in NumPy's files, read without ever unpickling and without trusting the header's size."""

import ast
import math
import re
import struct
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
from stereokit.errors import InputError, printable
from stereokit.files import atomic_path, read_file_bytes

__all__ = ["NPY_MAGIC", "npz_holds", "read_npy", "read_npz", "write_npy", "write_npz"]

NPY_MAGIC = b"\x93NUMPY"
_HEADER_LIMIT = 4096
_TYPE = re.compile(r"[<>=|]?[a-zA-Z?]\d{0,3}")
_STORED_OR_DEFLATED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, OSError, ValueError, struct.error)
_PIECE = 2**20


def read_npy(path: PathLike) -> Disparity:
    """Reads a disparity map from a .npy file.

    Returns:
        (H, W) float32, NaN where the file holds NaN or an infinite value.

    Raises:
        InputError: a missing, malformed, truncated or too large file, or an array that is not (H, W) of
            numbers.
    """
    read_file_bytes(path, 0)  # whether it is a file
    try:
        with open(path, "rb") as file:
            return _read_stream(path, file)
    except OSError as error:
        raise InputError(f"{printable(path)} can't be read: {error.strerror or error}") from error


def write_npy(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map as float32 .npy, unknown as NaN.

    Raises:
        InputError: `disparity` is not (H, W), or the file can't be written.
    """
    values = to_disparity(path, disparity)
    with atomic_path(path, overwrite=overwrite) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)


def read_npz(path: PathLike, *, entry: str | None = None) -> Disparity:
    """Reads a disparity map from a .npz file that holds one array, or one named "disparity".

    Args:
        path: the file.
        entry: the name of another array to read, such as "confidence".

    Returns:
        (H, W) float32, NaN where the file holds NaN or an infinite value.

    Raises:
        InputError: a missing, malformed, truncated or too large file, several arrays none of which is
            "disparity", or an array that is not (H, W) of numbers.
    """
    name = printable(path)
    try:
        read_file_bytes(path, 0)  # whether it is a file
        with zipfile.ZipFile(path) as archive:
            names = [entry for entry in archive.namelist() if entry.endswith(".npy")]
            wanted = "disparity" if entry is None else entry
            chosen = f"{wanted}.npy" if f"{wanted}.npy" in names else None
            if chosen is None and entry is None and len(names) == 1:
                chosen = names[0]
            if chosen is None:
                keys = ", ".join(repr(key[:-4][:40]) for key in names[:8]) or "no arrays"
                one = "one array, or " if entry is None else ""
                raise InputError(f"{name} holds {keys}; expected {one}one named {wanted!r}")
            if archive.getinfo(chosen).compress_type not in _STORED_OR_DEFLATED:
                raise InputError(f"{name} is compressed as numpy never does; write it with numpy.savez_compressed")
            with archive.open(chosen) as file:
                return _read_stream(path, file)
    except InputError:
        raise
    except _BROKEN_ZIP as error:
        raise InputError(f"{name} is a broken npz: {_first_line(error)}") from error


def npz_holds(path: PathLike, entry: str) -> bool:
    """Whether a .npz file holds an array of this name; False for files of another kind too.

    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.npz"
    >>> write_npz(path, [[1.0]])
    >>> npz_holds(path, "disparity"), npz_holds(path, "confidence")
    (True, False)
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return f"{entry}.npy" in archive.namelist()
    except _BROKEN_ZIP:
        return False


def write_npz(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map as a compressed .npz with the float32 array "disparity", unknown as NaN.

    Raises:
        InputError: `disparity` is not (H, W), or the file can't be written.
    """
    values = to_disparity(path, disparity)
    with atomic_path(path, overwrite=overwrite) as temporary:
        save_arrays(temporary, disparity=values)


def save_arrays(path: PathLike, **arrays: npt.NDArray[Any]) -> None:
    """What `numpy.savez_compressed` does, at the fastest level of compression.

    Floating-point maps gain less than a hundredth from the usual one, which takes twice the time.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "maps.npz"
    >>> save_arrays(path, confidence=np.ones((2, 3)))
    >>> np.load(path)["confidence"].shape
    (2, 3)
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _read_stream(path: PathLike, file: IO[bytes]) -> Disparity:
    """Reads an array after checking its header, which decides how much memory is reserved."""
    name = printable(path)
    try:
        shape, fortran_order, dtype = _read_header(file)
    except (ValueError, TypeError, KeyError, SyntaxError, MemoryError, RecursionError, OverflowError) as error:
        raise InputError(f"{name} is a broken npy: {_first_line(error)}") from error
    if dtype.kind not in "fiu" or len(shape) != 2:
        raise InputError(f"{name} holds {dtype} of shape {str(shape)[:80]}; expected real numbers of shape (H, W)")
    check_claimed_size(path, shape, dtype.itemsize)
    expected = math.prod(shape) * dtype.itemsize
    data = bytearray()
    while len(data) < expected and (piece := file.read(min(_PIECE, expected - len(data)))):
        data += piece
    if len(data) < expected:
        raise InputError(f"{name} is truncated: {expected} bytes of data announced, {len(data)} there")
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
    if not (isinstance(header, dict) and header.keys() == {"descr", "fortran_order", "shape"}):
        raise ValueError("its header does not name descr, fortran_order and shape")
    shape, fortran_order, kind = header["shape"], header["fortran_order"], header["descr"]
    # bool is a kind of int
    if not (isinstance(shape, tuple) and all(type(side) is int for side in shape)):
        raise ValueError("its shape is not made of whole numbers")
    if type(fortran_order) is not bool or not (isinstance(kind, str) and _TYPE.fullmatch(kind)):
        raise ValueError("its type is not one of plain numbers")
    return shape, fortran_order, np.dtype(kind)


def _first_line(error: BaseException) -> str:
    # where an object lies is no news
    return re.sub(r" at 0x[0-9a-f]+", "", (str(error) or repr(error)).splitlines()[0])[:120]
