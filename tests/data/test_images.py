import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.image_header import read_image_header
from stereokit.data.images import MAX_PIXELS, read_image, read_samples, write_image
from stereokit.errors import InputError
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))
RNG = np.random.default_rng(0)
COLOUR = RNG.integers(0, 256, (7, 5, 3), np.uint8)
COLOUR[0, 0] = (200, 100, 50)


def encode(suffix, samples):
    return cv2.imencode(suffix, samples[..., ::-1] if samples.ndim == 3 else samples)[1].tobytes()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, depth, colour_type, rows):
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@given(image=hnp.arrays(np.uint8, SHAPES), suffix=st.sampled_from([".png", ".ppm", ".bmp", ".tif", ".webp"]))
@settings(max_examples=50)
def test_eight_bits_round_trip(tmp_path_factory, image, suffix):
    path = tmp_path_factory.mktemp("images") / f"image{suffix}"
    write_image(path, image)
    np.testing.assert_array_equal(read_image(path), image)


@given(samples=hnp.arrays(np.uint16, SHAPES), suffix=st.sampled_from([".png", ".ppm", ".tiff"]))
@settings(max_examples=50)
def test_sixteen_bits_round_trip(tmp_path_factory, samples, suffix):
    path = tmp_path_factory.mktemp("images") / f"image{suffix}"
    image = (samples / 65535).astype(np.float32)
    write_image(path, image)
    back = read_image(path)
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, image)


def test_jpeg_keeps_the_channel_order(tmp_path):
    write_image(tmp_path / "red.jpg", np.full((16, 16, 3), [250, 20, 10], np.uint8))
    np.testing.assert_allclose(read_image(tmp_path / "red.jpg")[8, 8], [250, 20, 10], atol=6)


@pytest.mark.parametrize("suffix", [".png", ".pgm", ".jpg", ".tif", ".bmp"])
def test_grey_is_repeated(tmp_path, suffix):
    (tmp_path / f"grey{suffix}").write_bytes(encode(suffix, np.full((8, 8), 77, np.uint8)))
    image = read_image(tmp_path / f"grey{suffix}")
    assert image.shape == (8, 8, 3)
    assert image.dtype == np.uint8
    assert (image == 77).all()


def test_deep_grey(tmp_path):
    (tmp_path / "grey.png").write_bytes(encode(".png", np.array([[0, 13107, 65535]], np.uint16)))
    np.testing.assert_allclose(read_image(tmp_path / "grey.png"), np.repeat([[[0.0], [0.2], [1.0]]], 3, axis=2))


def test_alpha_is_dropped(tmp_path):
    rgba = np.dstack([COLOUR, np.full(COLOUR.shape[:2], 128, np.uint8)])
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", rgba[..., [2, 1, 0, 3]])[1].tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), COLOUR)
    np.testing.assert_array_equal(read_samples(tmp_path / "a.png"), rgba)
    grey_alpha = b"\0" + bytes([9, 0, 8, 255])
    (tmp_path / "ga.png").write_bytes(png(2, 1, 8, 4, grey_alpha))
    assert read_image(tmp_path / "ga.png")[0, :, 0].tolist() == [9, 8]


@pytest.mark.parametrize(
    ("peak", "expected"), [(15, [0, 17, 255]), (255, [0, 1, 15]), (1023, [0, 1 / 1023, 15 / 1023])]
)
def test_pnm_names_its_white(tmp_path, peak, expected):
    stored = np.array([0, 1, 15], "u1" if peak < 256 else ">u2")
    (tmp_path / "a.pgm").write_bytes(b"P5\n# a comment\n3 1\n%d\n" % peak + stored.tobytes())
    np.testing.assert_allclose(read_image(tmp_path / "a.pgm")[0, :, 0], expected, rtol=1e-6)
    assert read_samples(tmp_path / "a.pgm").tolist() == [[0, 1, 15]]


def tiff(width, height, tile_width, tile_height):
    sides = {256: width, 257: height, 322: tile_width, 323: tile_height}
    entries = [(tag, 4, 1, side) for tag, side in sides.items()]
    return b"II*\0\x08\0\0\0" + struct.pack("<H", 4) + b"".join(struct.pack("<HHII", *e) for e in entries) + bytes(4)


def with_size(data, at, form, *size):
    return data[:at] + struct.pack(form, *size) + data[at + struct.calcsize(form) :]


HUGE = {
    "png": png(10**9, 10**9, 8, 2, b""),
    "pgm": b"P5 1000000000 1000000000 255 ",
    "ppm of text": b"P3 1000000000 1000000000 255 1 2 3",
    "jpeg": b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 8, 8, 65535, 65535, 0) + b"\xff\xda\0\2\0\xff\xd9",
    "bmp": with_size(encode(".bmp", COLOUR), 18, "<ii", 10**9, -(10**9)),
    "webp": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0\xff\xff\xff\xff\xff\xff",
    "tiff": tiff(10**9, 8, 8, 8),
    "tiff of wide tiles": tiff(8, 8, 10**9, 8),
    "tiff of high tiles": tiff(8, 8, 8, 10**9),
}


@pytest.mark.parametrize("kind", HUGE)
def test_a_huge_claim_is_refused_before_decoding(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "huge").write_bytes(HUGE[kind])
    with pytest.raises(InputError, match=rf"claims \d+ x \d+ pixels; expected .* at most {MAX_PIXELS}"):
        read_image(tmp_path / "huge")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".webp", ".tif"])
def test_header_agrees_with_the_decoder(suffix):
    header = read_image_header(encode(suffix, COLOUR))
    assert (header.width, header.height) == (5, 7)


def test_webp_headers():
    lossy = cv2.imencode(".webp", np.zeros((30, 40, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()
    assert lossy[12:16] == b"VP8 "
    assert read_image_header(lossy).width == 40
    extended = b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + bytes([39, 0, 0, 29, 0, 0])
    assert (read_image_header(extended).width, read_image_header(extended).height) == (40, 30)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".webp", ".tif"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.6, 0.97])
def test_truncated(tmp_path, suffix, part):
    whole = encode(suffix, RNG.integers(0, 256, (40, 50, 3), np.uint8))
    (tmp_path / f"cut{suffix}").write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(InputError, match=rf"cut\{suffix}"):
        read_image(tmp_path / f"cut{suffix}")


@pytest.mark.parametrize(("suffix", "message"), [(".png", "ends early"), (".jpg", "ends")])
def test_the_end_is_looked_for_before_decoding(suffix, message):
    whole = encode(suffix, COLOUR)
    assert read_image_header(whole + b"something after it") == read_image_header(whole)
    for missing in (1, 2, 13, len(whole) // 2):
        with pytest.raises(ValueError, match=message):
            read_image_header(whole[:-missing])


def test_a_flipped_bit_in_a_png(tmp_path):
    whole = bytearray(encode(".png", COLOUR))
    whole[len(whole) // 2] ^= 4
    (tmp_path / "a.png").write_bytes(whole)
    with pytest.raises(InputError, match="checksum of its 'IDAT' chunk"):
        read_image(tmp_path / "a.png")


def test_files_that_are_no_images(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_image(tmp_path / "absent.png")
    with pytest.raises(InputError, match="is a folder"):
        read_image(tmp_path)
    (tmp_path / "empty.png").touch()
    with pytest.raises(InputError, match="is empty"):
        read_image(tmp_path / "empty.png")
    (tmp_path / "text.png").write_text("<html>not found</html>")
    with pytest.raises(InputError, match=r"no image that can be read \(it begins with b'<html>"):
        read_image(tmp_path / "text.png")
    (tmp_path / "float.tif").write_bytes(cv2.imencode(".tif", np.zeros((2, 2), np.float32))[1].tobytes())
    with pytest.raises(InputError, match="float32 samples"):
        read_image(tmp_path / "float.tif")


def test_a_device_is_not_read_for_ever():
    with pytest.raises(InputError, match="device"):
        read_image("/dev/zero")


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("a.png", np.zeros((2, 2), np.uint8), r"\(H, W, 3\)"),
        ("a.png", np.zeros((0, 2, 3), np.uint8), r"\(H, W, 3\)"),
        ("a.png", np.zeros((2, 2, 3), np.int64), "expected uint8, or float"),
        ("a.png", np.full((2, 2, 3), 128.0), r"in \[0, 1\]"),
        ("a.png", np.full((2, 2, 3), np.nan), r"in \[0, 1\]"),
        ("a.jpg", np.zeros((2, 2, 3)), r"16-bit images are written as .*, not '.jpg'"),
        ("a.gif", np.zeros((2, 2, 3), np.uint8), r"8-bit images are written as .*, not '.gif'"),
    ],
)
def test_what_is_not_written(tmp_path, name, array, message):
    with pytest.raises(InputError, match=message):
        write_image(tmp_path / name, array)
    assert not list(tmp_path.iterdir())


def test_what_the_format_can_not_hold(tmp_path):
    with pytest.raises(InputError, match=r"shape \(1, 70000, 3\) can't be encoded as '.jpg'"):
        write_image(tmp_path / "wide.jpg", np.zeros((1, 70000, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_writing_does_not_overwrite(tmp_path):
    write_image(tmp_path / "a.png", COLOUR)
    with pytest.raises(InputError, match="exists already"):
        write_image(tmp_path / "a.png", COLOUR[:2])
    write_image(tmp_path / "a.png", COLOUR[:2], overwrite=True)
    assert read_image(tmp_path / "a.png").shape == (2, 5, 3)


ORIGINALS = [encode(suffix, COLOUR) for suffix in (".png", ".jpg", ".bmp", ".ppm", ".webp", ".tif")]


@given(data=damaged(ORIGINALS))
@settings(max_examples=300, deadline=None)
def test_no_file_crashes_the_reader(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(data)
    image = outcome(read_image, path)
    assert isinstance(image, str) or image.shape[2:] == (3,)


@needs_shared
def test_real_images_agree_with_opencv():
    for name in (
        "kitti2012/training/image_0/000027_10.png",
        "middlebury/teddy/imL.png",
        "sceneflow/left/0.png",
    ):
        path = SHARED / "data" / "real" / name
        np.testing.assert_array_equal(read_image(path), cv2.imread(str(path))[..., ::-1])
