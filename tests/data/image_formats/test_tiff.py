import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.image_formats import read_header
from stereokit.data.image_formats.lzw import decode_lzw
from tests.data.encoded import encode, tiff

TYPES = st.sampled_from([np.uint8, np.uint16, np.float32, np.float64])
SHAPES = st.tuples(st.integers(1, 40), st.integers(1, 40)) | st.tuples(
    st.integers(1, 40), st.integers(1, 40), st.integers(3, 4)
)


@st.composite
def pictures(draw):
    kind, shape, seed = draw(TYPES), draw(SHAPES), draw(st.integers(0, 2**32 - 1))
    # few values repeat, many do not: both sides of every compression
    return np.random.default_rng(seed).integers(0, draw(st.sampled_from([1, 2, 200])), shape).astype(kind)


@given(
    picture=pictures(),
    compression=st.sampled_from([1, 8, 32773]),
    rows=st.sampled_from([None, 1, 7]),
    tile=st.sampled_from([None, 16]),
    planar=st.booleans(),
    order=st.sampled_from("<>"),
)
def test_every_layout_gives_the_same_samples(picture, compression, rows, tile, planar, order):
    data = tiff(picture, compression=compression, rows=rows, tile=tile, planar=planar, order=order)
    image = read_header(data)
    assert (image.width, image.height) == (picture.shape[1], picture.shape[0])
    decoded = image.decode()
    assert decoded.dtype == picture.dtype
    np.testing.assert_array_equal(decoded, picture)


@given(picture=pictures(), compression=st.sampled_from([1, 5, 8, 32773]))
def test_what_opencv_writes(picture, compression):
    # LZW and Deflate with differences between neighbours
    data = encode(".tif", picture, [cv2.IMWRITE_TIFF_COMPRESSION, compression])
    np.testing.assert_array_equal(read_header(data).decode(), picture)


@given(data=st.binary(min_size=1, max_size=3000) | st.integers(1, 40000).map(bytes))
@settings(max_examples=50)
def test_lzw_of_any_bytes(data):
    # OpenCV's encoder, told to keep the bytes as they are
    rows = np.frombuffer(data, np.uint8)[None]
    written = cv2.imencode(".tif", rows, [cv2.IMWRITE_TIFF_COMPRESSION, 5, cv2.IMWRITE_TIFF_PREDICTOR, 1])[1].tobytes()
    assert read_header(written).decode().tobytes() == data


@pytest.mark.parametrize("code", [b"\x80\x7f\xff", b"\x80\x20\x3f\xff"])
def test_lzw_codes_that_are_not_in_the_table(code):
    with pytest.raises(ValueError, match="not in the table"):
        decode_lzw(code, 10)


@given(picture=hnp.arrays(st.sampled_from([np.uint8, np.uint16]), (3, 5), elements=st.integers(0, 255)))
def test_min_is_white_is_turned_around_in_any_depth(picture):
    top = np.iinfo(picture.dtype).max
    np.testing.assert_array_equal(read_header(tiff(picture, photometric=0)).decode(), top - picture)


def test_alpha_orientation_and_metadata_change_no_colour():
    picture = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for tags in ({338: [2]}, {338: [1]}, {274: [3]}, {274: [6], 34665: [1]}):
        np.testing.assert_array_equal(read_header(tiff(picture, tags=tags)).decode(), picture)


def test_bands_without_colours_are_red_green_blue_and_grey():
    picture = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    np.testing.assert_array_equal(read_header(tiff(picture, photometric=1)).decode(), picture)
    two = tiff(picture[:, :, :2], photometric=1)
    np.testing.assert_array_equal(read_header(two).decode(), picture[:, :, 0])


def test_palette_and_bits():
    numbers = np.array([[0, 1, 255]], np.uint8)
    palette = np.arange(768)
    data = tiff(numbers, photometric=3, tags={320: list(palette * 256)})
    np.testing.assert_array_equal(
        read_header(data).decode(), (palette.reshape(3, 256).T[numbers] % 256).astype(np.uint8)
    )
    bits = np.eye(12, dtype=np.uint8)[:, :11]
    packed = np.packbits(bits, axis=1)
    for photometric in (0, 1):
        data = tiff(packed, photometric=photometric, tags={256: [11], 258: [1]})
        np.testing.assert_array_equal(read_header(data).decode() == 255, bits == photometric)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({256: None}, "no value for its width"),
        ({258: [8, 16, 8]}, "several values for its bits"),
        ({258: [12]}, "unsigned samples of 12 bits; expected"),
        ({339: [2]}, "signed samples of 8 bits"),
        ({262: [5]}, "colours are of kind 5"),
        ({277: [8]}, "8 bands; expected 1"),
        ({266: [2]}, "bits are in reversed order"),
        ({262: [3], 277: [1]}, "palette"),
        ({259: [7]}, "compressed by method 7"),
        ({317: [3]}, "predictor is 3"),
        ({278: [0]}, "no size"),
        ({278: [1]}, "fewer than its 4 strips"),
        ({279: [5]}, "pixels end early"),
        ({273: [10**6]}, "pixels end early"),
        ({322: [2**20], 323: [2**20], 324: [8], 325: [9]}, "claims tiles of 1048576 x 1048576"),
    ],
)
def test_what_is_not_read(tags, message):
    with pytest.raises(ValueError, match=message):
        read_header(tiff(np.zeros((4, 5, 3), np.uint8), tags=tags)).decode()


@pytest.mark.parametrize("compression", [1, 8, 32773])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_pixels_that_are_not_there(compression, kind):
    picture = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(kind)
    with pytest.raises(ValueError, match=r"end early|damaged"):
        read_header(tiff(picture, compression=compression, rows=2, short=12)).decode()


@pytest.mark.parametrize("kept", [0, 1, 30, 60])
def test_lzw_that_ends_early(kept):
    picture = np.random.default_rng(0).integers(0, 255, (9, 7), np.uint8)
    written = encode(".tif", picture, [cv2.IMWRITE_TIFF_COMPRESSION, 5, cv2.IMWRITE_TIFF_PREDICTOR, 1])
    stream = np.frombuffer(written[8 : int.from_bytes(written[4:8], "little")], np.uint8)
    fields = {256: [7], 257: [9], 259: [5], 278: [9]}
    np.testing.assert_array_equal(read_header(tiff(stream[None], tags=fields)).decode(), picture)
    with pytest.raises(ValueError, match="end early"):
        read_header(tiff(stream[None, : kept + 1], tags=fields)).decode()


def test_too_many_strips():
    data = tiff(np.zeros((1, 1), np.uint8), tags={257: [70000], 278: [1]})
    with pytest.raises(ValueError, match="70000 strips"):
        read_header(data).decode()
