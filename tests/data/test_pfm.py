import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.pfm import read_pfm, write_pfm
from stereokit.errors import InputError
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared

VALUES = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
BLANK = st.sampled_from([b" ", b"\n", b" \n", b"\t", b"\r\n", b"\n# a comment 7 8\n", b" # x\n \n"])


def pfm(header, values=VALUES, order="<"):
    return header + values[::-1].astype(order + "f4").tobytes()


@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.floats(width=32, allow_nan=True, allow_infinity=True),
    )
)
def test_round_trip(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "a.pfm"
    write_pfm(path, values, overwrite=True)
    np.testing.assert_array_equal(read_pfm(path), np.where(np.isfinite(values), values, np.nan))


@given(
    blanks=st.tuples(BLANK, BLANK, BLANK),
    end=st.sampled_from([b"\n", b" \n", b"\r\n", b"\t # comment\n"]),
    scale=st.sampled_from([b"-1", b"-1.0", b"1", b"+1.0", b"-0.003922", b"1e2", b"-1.000000e+00"]),
)
def test_any_header(tmp_path_factory, blanks, end, scale):
    path = tmp_path_factory.getbasetemp() / "a.pfm"
    order = "<" if scale.startswith(b"-") else ">"
    one, two, three = blanks
    path.write_bytes(pfm(b"Pf" + one + b"3" + two + b"2" + three + scale + end, order=order))
    np.testing.assert_array_equal(read_pfm(path), VALUES)


def test_data_that_look_like_header(tmp_path):
    values = np.frombuffer(b"\n#\n 12\n ", "<f4").reshape(1, 2)
    (tmp_path / "a.pfm").write_bytes(pfm(b"Pf\n2 1\n-1\n", values))
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), values)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pfm(b"Pf\n3 2\n-1\n")[:-1], "is truncated: a PFM of 3 x 2 .* has 34 bytes, the file 33"),
        (pfm(b"Pf\n3 2\n-1\n") + b"\n", "is malformed: .* has 34 bytes, the file 35"),
        (pfm(b"PF\n3 2\n-1\n"), "three channels"),
        (pfm(b"Pf\n1000000000 1000000000\n-1\n"), "claims 1000000000 x 1000000000 pixels"),
        (pfm(b"Pf\n0 2\n-1\n"), "claims 0 x 2 pixels"),
        (pfm(b"Pf\n-3 2\n-1\n"), "no PFM: expected a header"),
        (pfm(b"Pf\nthree two\n-1\n"), "no PFM: expected a header"),
        (pfm(b"Pf\n3 2\n0\n"), "scale is '0'"),
        (pfm(b"Pf\n3 2\n-e-\n"), "scale is '-e-'"),
        (pfm(b"Pf\n3 2\nnan\n"), "no PFM: expected a header"),
        (b"Pf\n3 2", "no PFM: expected a header"),
        (b"Pf" + b"#" * 10**6, "no PFM: expected a header"),
        (b"", "no PFM: expected a header"),
    ],
)
def test_malformed(tmp_path, content, message):
    (tmp_path / "a.pfm").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_pfm(tmp_path / "a.pfm")


def test_a_claim_reserves_no_memory(tmp_path):
    (tmp_path / "a.pfm").write_bytes(b"Pf\n10000 10000\n-1\n")
    tracemalloc.start()
    assert "truncated" in outcome(read_pfm, tmp_path / "a.pfm")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10**6


def test_only_maps_are_written(tmp_path):
    for values in (np.zeros(3), np.zeros((1, 2, 3)), np.zeros((0, 2)), [["a"]], [[1j]]):
        with pytest.raises(InputError, match=r"real numbers of shape \(H, W\)"):
            write_pfm(tmp_path / "a.pfm", values)
    assert not list(tmp_path.iterdir())


@given(data=damaged([pfm(b"Pf\n3 2\n-1\n"), pfm(b"Pf \n3 2 \n1.0\n", order=">")]))
@settings(max_examples=300)
def test_no_file_crashes_the_reader(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.pfm"
    path.write_bytes(data)
    values = outcome(read_pfm, path)
    assert isinstance(values, str) or (values.dtype == np.float32 and values.ndim == 2)


@needs_shared
def test_real_files():
    real = SHARED / "data" / "real"
    sceneflow = read_pfm(real / "sceneflow" / "disparity" / "left" / "0.pfm")
    assert sceneflow.shape == (540, 960)
    assert np.isfinite(sceneflow).all()
    # The sky is far and on top: the rows were turned the right way.
    assert sceneflow[:50].mean() < sceneflow[-50:].mean()
    eth3d = read_pfm(real / "eth3d" / "terrace" / "disp0.pfm")
    assert eth3d.shape == (434, 713)
    assert 0.4 < np.isnan(eth3d).mean() < 0.6
