import io
import pickle
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.npy import read_npy, read_npz, write_npy, write_npz
from stereokit.errors import InputError
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared

SHAPE = st.tuples(st.integers(1, 9), st.integers(1, 9))
READ_WRITE = [(read_npy, write_npy), (read_npz, write_npz)]


def npy(array, version=None):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version)
    return buffer.getvalue()


def claim(header):
    header = header.encode() + b" " * 20 + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header


def zipped(data, name="disparity.npy"):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.parametrize(("read", "write"), READ_WRITE)
@given(values=hnp.arrays(np.float32, SHAPE, elements=st.floats(width=32, allow_nan=True, allow_infinity=True)))
def test_round_trip(tmp_path_factory, read, write, values):
    path = tmp_path_factory.getbasetemp() / "a"
    write(path, values, overwrite=True)
    np.testing.assert_array_equal(read(path), np.where(np.isfinite(values), values, np.nan))


@given(
    values=hnp.arrays(st.sampled_from(["<f8", ">f4", "<f2", "u1", "<i4", ">u2"]), SHAPE, elements=st.integers(0, 200)),
    fortran=st.booleans(),
    version=st.sampled_from([(1, 0), (2, 0), (3, 0)]),
)
def test_any_real_type_order_and_version(tmp_path_factory, values, fortran, version):
    path = tmp_path_factory.getbasetemp() / "a.npy"
    path.write_bytes(npy(np.asfortranarray(values) if fortran else values, version))
    result = read_npy(path)
    assert result.dtype == np.float32
    assert result.flags.c_contiguous
    np.testing.assert_array_equal(result, values)


def test_a_double_beyond_float32_is_unknown(tmp_path):
    np.save(tmp_path / "a.npy", [[1e300, 1.0]])
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), [[np.nan, 1]])


def test_npz_names(tmp_path):
    values = np.ones((2, 2))
    np.savez(tmp_path / "one.npz", values)
    np.savez(tmp_path / "named.npz", disparity=values, confidence=values * 0)
    np.savez(tmp_path / "several.npz", left=values, right=values)
    np.savez(tmp_path / "none.npz")
    assert read_npz(tmp_path / "one.npz").tolist() == values.tolist()
    assert read_npz(tmp_path / "named.npz").tolist() == values.tolist()
    with pytest.raises(InputError, match="holds 'left', 'right'; expected one array"):
        read_npz(tmp_path / "several.npz")
    with pytest.raises(InputError, match="holds no arrays"):
        read_npz(tmp_path / "none.npz")


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("a pickle ran",)


def test_pickles_do_not_run(tmp_path):
    array = np.empty((1, 1), object)
    array[0, 0] = Bomb()
    header = claim("{'descr': '|O', 'fortran_order': False, 'shape': (1, 1)}")
    (tmp_path / "a.npy").write_bytes(header + pickle.dumps(array))
    (tmp_path / "b.npy").write_bytes(pickle.dumps(array))
    for name in ("a.npy", "b.npy"):
        with pytest.raises(InputError):
            read_npy(tmp_path / name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "broken npy"),
        (npy(np.ones((2, 2)))[:-1], "truncated: 32 bytes of data announced, 31 there"),
        (npy(np.ones((2, 2), complex)), r"holds complex128 of shape \(2, 2\)"),
        (npy(np.ones((2, 2), bool)), r"holds bool of shape \(2, 2\)"),
        (npy(np.ones((1, 2, 2))), r"of shape \(1, 2, 2\); expected real numbers of shape \(H, W\)"),
        (claim("{'descr': '<f4', 'fortran_order': False, 'shape': (-2, -2)}"), "claims -2 x -2 pixels"),
        (claim("{'descr': '<f4', 'fortran_order': False, 'shape': (0, 2)}"), "claims 2 x 0 pixels"),
        (
            claim("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000, 1000000000)}"),
            "claims 1000000000",
        ),
        (claim("{'descr': '<f4', 'fortran_order': False, 'shape': (10000, 10000)}"), "truncated: 400000000"),
        (claim("__import__('os')"), "broken npy"),
        (claim("(" * 9000), "broken npy"),
        (b"\x93NUMPY\2\0\xff\xff\xff\xff{", "header claims 4294967295 bytes"),
        (b"\x93NUMPY\x09\0\1\0{", "broken npy"),
        (claim("{'descr': '<f4', 'fortran_order': False, 'shape': (True, 2)}"), "not made of whole numbers"),
        (claim("{'descr': '<f4', 'fortran_order': 0, 'shape': (2, 2)}"), "type is not one of plain numbers"),
        (claim("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2, 2)}"), "not one of plain numbers"),
        (
            claim("{'descr': '<f16', 'fortran_order': False, 'shape': (9000, 9000)}"),
            "of 16 bytes; expected at most 1024",
        ),
        (claim("['descr']"), "does not name descr"),
    ],
)
def test_malformed(tmp_path, content, message):
    (tmp_path / "a.npy").write_bytes(content)
    (tmp_path / "a.npz").write_bytes(zipped(content))
    for read, name in ((read_npy, "a.npy"), (read_npz, "a.npz")):
        tracemalloc.start()
        result = outcome(read, tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert isinstance(result, str)
        assert pytest.approx(0, abs=2 * 10**7) == peak
        with pytest.raises(InputError, match=message):
            read(tmp_path / name)


def test_an_encrypted_or_damaged_member(tmp_path):
    good = zipped(npy(np.ones((4, 4))))
    encrypted = bytearray(good)
    for signature, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        encrypted[good.index(signature) + offset] |= 1
    (tmp_path / "a.npz").write_bytes(encrypted)
    with pytest.raises(InputError, match=r"broken npz: .*encrypted"):
        read_npz(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(good[:40])
    with pytest.raises(InputError, match="broken npz"):
        read_npz(tmp_path / "b.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_a_compression_that_numpy_does_not_write(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("disparity.npy", npy(np.ones((4, 4))))
    with pytest.raises(InputError, match="compressed as numpy never does; write it with"):
        read_npz(tmp_path / "a.npz")


def test_an_archive_that_swells_takes_little_memory(tmp_path):
    # 48 million zeros in 50 kB, of which the header wants 8
    (tmp_path / "a.npz").write_bytes(zipped(npy(np.ones((2, 2), np.float16)) + bytes(48 * 10**6)))
    tracemalloc.start()
    assert read_npz(tmp_path / "a.npz").shape == (2, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * 10**6


@given(data=damaged([npy(np.ones((3, 2), np.float32)), zipped(npy(np.ones((3, 2)))), zipped(b"x", "a.txt")]))
@settings(max_examples=300)
def test_no_file_crashes_the_readers(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(data)
    for read in (read_npy, read_npz):
        values = outcome(read, path)
        assert isinstance(values, str) or (values.dtype == np.float32 and values.ndim == 2)


@needs_shared
def test_real_npz():
    values = read_npz(SHARED / "data" / "real" / "middlebury" / "Motorcycle" / "motorcycle_disp.npz")
    assert values.shape == (500, 741)
    assert 7 < np.nanmin(values) < np.nanmax(values) < 60
