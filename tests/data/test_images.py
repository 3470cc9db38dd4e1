import os
import resource
import struct
import warnings

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.data.image_formats import read_header
from stereokit.data.images import MAX_BYTES, MAX_PIXELS, read_image, read_samples, write_image
from stereokit.errors import InputError
from tests.data.encoded import encode, png, tiff
from tests.data.hostile import damaged, outcome
from tests.shared import SHARED, needs_shared

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))
RNG = np.random.default_rng(0)
COLOUR = RNG.integers(0, 256, (7, 5, 3), np.uint8)
COLOUR[0, 0] = (200, 100, 50)


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


def with_size(data, at, form, *size):
    return data[:at] + struct.pack(form, *size) + data[at + struct.calcsize(form) :]


HUGE = {
    "png": png(10**9, 10**9, 8, 2, b""),
    "pgm": b"P5 1000000000 1000000000 255 ",
    "ppm of text": b"P3 1000000000 1000000000 255 1 2 3",
    "jpeg": b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 8, 8, 65535, 65535, 0) + b"\xff\xda\0\2\0\xff\xd9",
    "bmp": with_size(encode(".bmp", COLOUR), 18, "<ii", 10**9, -(10**9)),
    "webp": b"RIFF\x20\0\0\0WEBPVP8L\x06\0\0\0\x2f\xff\xff\xff\x0f\0",
    "tiff": tiff(np.zeros((1, 1), np.uint8), tags={256: [10**9], 257: [10**9]}),
}


@pytest.mark.parametrize("kind", HUGE)
def test_a_huge_claim_is_refused_before_decoding(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "huge").write_bytes(HUGE[kind])
    with pytest.raises(InputError, match=rf"claims \d+ x \d+ pixels; expected .* at most {MAX_PIXELS}"):
        read_image(tmp_path / "huge")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".webp", ".tif"])
def test_header_agrees_with_the_decoder(suffix):
    header = read_header(encode(suffix, COLOUR))
    assert (header.width, header.height) == (5, 7)


def test_webp_headers():
    lossy = cv2.imencode(".webp", np.zeros((30, 40, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()
    assert lossy[12:16] == b"VP8 "
    assert (read_header(lossy).width, read_header(lossy).height) == (40, 30)


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
    assert read_header(whole + b"something after it") == read_header(whole)
    for missing in (1, 2, 13, len(whole) // 2):
        with pytest.raises(ValueError, match=message):
            read_header(whole[:-missing])


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
        read_samples(tmp_path / "float.tif")


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


@pytest.mark.parametrize(
    ("width", "depth", "colour", "memory"), [(6500, 16, 6, 1128), (9500, 8, 4, 989), (8000, 16, 0, 976)]
)
def test_the_memory_that_decoding_takes_is_known_before(tmp_path, monkeypatch, width, depth, colour, memory):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: np.zeros((1, 1), np.uint8))
    (tmp_path / "a.png").write_bytes(png(width, width, depth, colour, b""))
    refused = memory > MAX_BYTES // 2**20
    message = rf"take {memory} MiB to decode; expected at most 1024 MiB" if refused else "another size than its data"
    with pytest.raises(InputError, match=message):
        read_image(tmp_path / "a.png")


def test_decoding_takes_no_more_memory_than_was_said(tmp_path):
    # 36 bytes a pixel at most are 520 MiB here; a child process would measure the same
    (tmp_path / "a.png").write_bytes(png(4000, 4000, 16, 6, bytes(4000 * (1 + 4000 * 8))))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read_samples(tmp_path / "a.png")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**10 * 500


def test_floating_point_tiff(tmp_path):
    values = np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 4, 3)
    (tmp_path / "a.tif").write_bytes(tiff(values))
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), values)
    (tmp_path / "deep.tif").write_bytes(tiff(values * 4095))
    with pytest.raises(InputError, match=r"from 0 to 4095; expected \[0, 1\]; .*say bit_depth"):
        read_image(tmp_path / "deep.tif")
    np.testing.assert_allclose(read_image(tmp_path / "deep.tif", bit_depth=12), values, rtol=1e-6)
    (tmp_path / "nan.tif").write_bytes(tiff(values * np.nan))
    with pytest.raises(InputError, match="24 values that are NaN"):
        read_image(tmp_path / "nan.tif")


def test_min_is_white_in_images(tmp_path):
    for top, kind in ((255, np.uint8), (65535, np.uint16)):
        (tmp_path / "a.tif").write_bytes(tiff(np.array([[0, top]], kind), photometric=0))
        assert read_image(tmp_path / "a.tif")[0, :, 0].tolist() == ([255, 0] if top == 255 else [1, 0])


def test_bit_depth(tmp_path):
    samples = np.array([[0, 1024, 4095]], np.uint16)
    (tmp_path / "a.png").write_bytes(encode(".png", samples))
    np.testing.assert_allclose(read_image(tmp_path / "a.png", bit_depth=12)[0, :, 1], [0, 1024 / 4095, 1], rtol=1e-6)
    with pytest.raises(InputError, match="samples up to 4095; bit_depth=10 allows 1023"):
        read_image(tmp_path / "a.png", bit_depth=10)
    for wrong in (0, 17, 12.0, True, "12"):
        with pytest.raises(InputError, match="whole number from 1 to 16"):
            read_image(tmp_path / "a.png", bit_depth=wrong)
    (tmp_path / "b.png").write_bytes(encode(".png", COLOUR))
    with pytest.raises(InputError, match="8 bits per sample: leave out bit_depth=12"):
        read_image(tmp_path / "b.png", bit_depth=12)
    (tmp_path / "c.pgm").write_bytes(b"P5 2 1 1023 " + bytes([0, 5, 1, 7]))
    with pytest.raises(InputError, match="names 1023 as its white"):
        read_image(tmp_path / "c.pgm", bit_depth=12)


@pytest.mark.parametrize(("top", "bits"), [(1, 1), (4095, 12), (16383, 14), (16384, None), (65535, None), (0, None)])
def test_dark_sixteen_bits_are_warned_of(tmp_path, top, bits):
    samples = np.zeros((30, 40), np.uint16)
    samples[3, 4] = top
    (tmp_path / "a.png").write_bytes(encode(".png", samples))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_image(tmp_path / "a.png")
    assert [f"need {bits} bits only" in str(warning.message) for warning in caught] == ([True] if bits else [])
    if bits:
        read_image(tmp_path / "a.png", bit_depth=bits)


def test_names_are_printable(tmp_path):
    for name in (b"a\x1b[31m.png", b"new\nline.png", b"not utf \xff.png", b"long" * 50):
        with pytest.raises(InputError, match="does not exist") as caught:
            read_image(tmp_path / os.fsdecode(name))
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 400
        str(caught.value).encode()


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
