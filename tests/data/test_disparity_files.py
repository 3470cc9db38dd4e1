import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data import read_disparity, write_disparity
from stereokit.data.disparity_arrays import doubts
from stereokit.data.disparity_files import ENCODINGS, assumed_scale
from stereokit.data.images import write_samples
from stereokit.errors import InputError
from tests.data.encoded import tiff
from tests.data.hostile import damaged, outcome

QUARTERS = st.integers(1, 1000).map(lambda n: n / 4) | st.just(float("nan"))


@given(
    values=hnp.arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=QUARTERS),
    suffix=st.sampled_from([".pfm", ".png", ".npy", ".npz", ".PFM"]),
    other=st.sampled_from([".bin", ".txt", ".pfm", ".png", ""]),
)
def test_the_content_decides_not_the_name(tmp_path_factory, values, suffix, other):
    folder = tmp_path_factory.getbasetemp()
    write_disparity(folder / f"a{suffix}", values, overwrite=True)
    renamed = (folder / f"a{suffix}").rename(folder / f"b{other}")
    result = read_disparity(renamed)
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, values)


def test_eight_bits_need_a_scale(tmp_path):
    write_samples(tmp_path / "a.png", np.array([[0, 8]], np.uint8), overwrite=False)
    with pytest.raises(InputError, match="does not say how disparity was scaled; give scale="):
        read_disparity(tmp_path / "a.png")
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png", scale=4), [[np.nan, 2]])


def test_sixteen_bits_may_have_another_scale(tmp_path):
    write_samples(tmp_path / "a.png", np.array([[0, 512]], np.uint16), overwrite=False)
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png"), [[np.nan, 2]])
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png", encoding="drivingstereo"), [[np.nan, 2]])
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png", encoding="drivingstereo-full"), [[np.nan, 4]])
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png", scale=64), [[np.nan, 8]])


def test_a_colour_picture_is_not_taken_for_disparity(tmp_path):
    write_samples(tmp_path / "a.png", np.array([[[1, 64, 0]]], np.uint8), overwrite=False)
    with pytest.raises(InputError, match="say encoding='sintel'"):
        read_disparity(tmp_path / "a.png")
    assert read_disparity(tmp_path / "a.png", encoding="sintel").tolist() == [[5]]


def test_contradictions(tmp_path):
    write_disparity(tmp_path / "a.pfm", [[1.0]])
    with pytest.raises(InputError, match="has no scale; leave out scale=4"):
        read_disparity(tmp_path / "a.pfm", scale=4)
    with pytest.raises(InputError, match="give scale or encoding, not both"):
        read_disparity(tmp_path / "a.pfm", scale=4, encoding="pfm")
    with pytest.raises(InputError, match=r"unknown disparity encoding 'kity'; expected one of pfm, npy"):
        read_disparity(tmp_path / "a.pfm", encoding="kity")
    with pytest.raises(InputError, match="no image"):
        read_disparity(tmp_path / "a.pfm", encoding="kitti")
    with pytest.raises(InputError, match="does not exist"):
        read_disparity(tmp_path / "absent.pfm")


def test_only_known_suffixes_are_written(tmp_path):
    with pytest.raises(InputError, match=r"written as \.pfm, \.png, \.npy, \.npz, not '\.jpg'"):
        write_disparity(tmp_path / "a.jpg", [[1.0]])


@pytest.mark.parametrize("suffix", [".pfm", ".png", ".npy", ".npz"])
def test_nothing_is_overwritten(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_disparity(path, [[1.0]])
    with pytest.raises(InputError, match="exists already"):
        write_disparity(path, [[2.0]])
    assert read_disparity(path).tolist() == [[1]]
    write_disparity(path, [[2.0]], overwrite=True)
    assert read_disparity(path).tolist() == [[2]]


@given(data=st.data(), options=st.sampled_from([{}, {"scale": 4}, *({"encoding": name} for name in ENCODINGS)]))
@settings(max_examples=200, deadline=None)
def test_no_file_crashes_the_reader(tmp_path_factory, data, options):
    folder = tmp_path_factory.getbasetemp()
    originals = []
    for suffix in (".pfm", ".png", ".npy", ".npz"):
        write_disparity(folder / f"fuzz{suffix}", [[1.0, 2.0]], overwrite=True)
        originals.append((folder / f"fuzz{suffix}").read_bytes())
    (folder / "damaged").write_bytes(data.draw(damaged(originals)))
    values = outcome(lambda path: read_disparity(path, **options), folder / "damaged")
    assert isinstance(values, str) or (values.dtype == np.float32 and values.ndim == 2)


def test_floating_point_tiff_is_disparity(tmp_path):
    values = np.array([[1.5, np.nan, np.inf]], np.float32)
    for kind in (np.float32, np.float64):
        (tmp_path / "a.tif").write_bytes(tiff(values.astype(kind)))
        np.testing.assert_array_equal(read_disparity(tmp_path / "a.tif"), [[1.5, np.nan, np.nan]])
    with pytest.raises(InputError, match="has no scale; leave out scale=4"):
        read_disparity(tmp_path / "a.tif", scale=4)
    assert assumed_scale(tmp_path / "a.tif") is None


def test_the_scale_that_is_assumed(tmp_path):
    for name, samples, scale in (
        ("a.png", np.ones((2, 2), np.uint16), 256),
        ("b.png", np.ones((2, 2), np.uint8), None),
        ("c.tif", np.ones((2, 2), np.uint16), 256),
    ):
        write_samples(tmp_path / name, samples, overwrite=False)
        assert assumed_scale(tmp_path / name) == scale
    assert assumed_scale(tmp_path / "absent.png") is None


@pytest.mark.parametrize("suffix", [".pfm", ".npy", ".npz", ".png"])
def test_the_whole_numbers_of_opencv_are_not_written(tmp_path, suffix):
    raw = np.array([[160, 245, -16]], np.int16)
    with pytest.raises(InputError, match=r"as cv2\.StereoSGBM gives 16 times the disparity: divide by 16\.0"):
        write_disparity(tmp_path / f"a{suffix}", raw)
    with pytest.raises(InputError, match="whole numbers below 0; expected disparity in pixels, NaN where unknown"):
        write_disparity(tmp_path / f"a{suffix}", np.array([[5, -1]]))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([[-1.0, -2.0]], "all disparities are negative, -2 to -1: if they count leftward"),
        ([[16.0, 160.0, np.nan]], "all disparities are multiples of 16"),
        ([[16, 160]], "all disparities are multiples of 16"),
        ([[16.0, 17.0]], None),
        ([[16.0, 16.0]], None),
        ([[np.nan]], None),
        ([[0.0, 3.0]], None),
    ],
)
def test_doubts(values, message):
    found = doubts(np.array(values))
    assert found is None if message is None else message in found
