"""That a decoder sees a still picture and nothing else, whatever the file holds besides."""

import struct

import cv2
import numpy as np
import pytest

from stereokit.data.image_formats import encoded, read_header
from stereokit.data.images import read_image
from stereokit.errors import InputError
from tests.data.encoded import animated_png, chunk, encode, png

PICTURE = np.random.default_rng(0).integers(0, 255, (16, 24, 3), np.uint8)


@pytest.fixture
def decoded(monkeypatch):
    """The bytes that OpenCV was given."""
    seen = []
    real = cv2.imdecode
    monkeypatch.setattr(encoded.cv2, "imdecode", lambda data, flags: seen.append(data.tobytes()) or real(data, flags))
    return seen


def test_an_animated_png_is_its_still_picture(tmp_path, decoded):
    (tmp_path / "a.png").write_bytes(animated_png())
    assert read_image(tmp_path / "a.png")[0].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not any(kind in decoded[0] for kind in (b"acTL", b"fcTL", b"fdAT"))
    (tmp_path / "b.png").write_bytes(animated_png(pixels=b"\0\0\1"))
    with pytest.raises(InputError, match="broken image"):
        read_image(tmp_path / "b.png")


def test_png_chunks_that_no_picture_needs(decoded):
    extra = b"".join(chunk(kind, b"\0" * 9) for kind in (b"eXIf", b"iCCP", b"zTXt", b"gAMA", b"acTL"))
    assert read_header(png(2, 1, 8, 0, b"\0\7\x09", extra)).decode().tolist() == [[7, 9]]
    assert decoded == [png(2, 1, 8, 0, b"\0\7\x09")]
    with pytest.raises(ValueError, match="'CgBI' is none that PNG knows"):
        read_header(png(2, 1, 8, 0, b"\0\7\x09", chunk(b"CgBI", b"1234")))
    with pytest.raises(ValueError, match="colour type 1 and 8 bits"):
        read_header(png(2, 1, 8, 1, b"\0\7\x09"))


def test_jpeg_segments_that_no_picture_needs(decoded):
    plain = encode(".jpg", PICTURE)
    metadata = b"\xff\xe1" + struct.pack(">H", 40) + b"Exif\0\0" + b"\xff" * 32 + b"\xff\xfe\0\4hi"
    image = read_header(plain[:2] + metadata + plain[2:] + b"another file")
    np.testing.assert_array_equal(image.decode(), cv2.imdecode(np.frombuffer(plain, np.uint8), -1)[..., ::-1])
    assert b"Exif" not in decoded[0]
    assert decoded[0] == plain


@pytest.mark.parametrize("stray", [b"\0\0", b"ab", b"\xff\0", b"\xff\xff\xff"])
def test_bytes_between_jpeg_segments_are_skipped_as_decoders_do(stray):
    plain = encode(".jpg", PICTURE)
    at = plain.index(b"\xff\xdb")
    expected = cv2.imdecode(np.frombuffer(plain, np.uint8), -1)[..., ::-1]
    np.testing.assert_array_equal(read_header(plain[:at] + stray + plain[at:]).decode(), expected)


def test_a_progressive_jpeg_and_one_that_never_ends():
    progressive = encode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    expected = cv2.imdecode(np.frombuffer(progressive, np.uint8), -1)[..., ::-1]
    np.testing.assert_array_equal(read_header(progressive).decode(), expected)
    at = progressive.index(b"\xff\xc2")
    wide = progressive[: at + 5] + struct.pack(">HH", 9000, 9000) + progressive[at + 9 :]
    scan = progressive.rindex(b"\xff\xda")
    with pytest.raises(ValueError, match="times; save it as PNG"):
        read_header(wide[:scan] + progressive[scan:-2] * 100 + wide[-2:])
    # one long run of markers takes no time
    assert read_header(b"\xff\xd8\xff" + progressive[2:-2] + b"\xff" * 10**6 + progressive[-2:])


def test_jpeg_of_twelve_bits():
    plain = encode(".jpg", PICTURE)
    at = plain.index(b"\xff\xc0") + 4
    with pytest.raises(ValueError, match="12 bits per sample"):
        read_header(plain[:at] + b"\x0c" + plain[at + 1 :])


def test_webp_without_metadata_and_animation(decoded):
    alpha = np.dstack([PICTURE, np.full(PICTURE.shape[:2], 9, np.uint8)])
    for picture in (PICTURE, alpha):
        plain = encode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])
        exif = b"EXIF" + struct.pack("<I", 6) + b"II*\0\xff\xff"
        image = read_header(plain + exif)
        assert (image.width, image.height) == (24, 16)
        np.testing.assert_array_equal(image.decode(), picture)
        assert b"EXIF" not in decoded[-1]
    extended = b"VP8X" + struct.pack("<I", 10)
    for body in (extended + b"\x02\0\0\0\1\0\0\1\0\0", b"ANIM" + struct.pack("<I", 6) + bytes(6)):
        with pytest.raises(ValueError, match="animated WebP; save one frame"):
            read_header(b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body)
    with pytest.raises(ValueError, match="no WebP"):
        read_header(b"RIFF\4\0\0\0WAVE")


def test_bmp_that_is_compressed_or_cut():
    plain = bytearray(encode(".bmp", PICTURE))
    with pytest.raises(ValueError, match="ends early"):
        read_header(bytes(plain[:-1]))
    plain[30:34] = struct.pack("<I", 1)
    with pytest.raises(ValueError, match="compressed BMP"):
        read_header(bytes(plain))
    plain[28:30] = b"\5\0"
    with pytest.raises(ValueError, match="5 bits per pixel"):
        read_header(bytes(plain))


@pytest.mark.parametrize("kind", [1, 2, 3])
def test_pnm_as_text_and_as_bytes(kind):
    values = np.array([[0, 1, 1], [1, 0, 1]])
    values = np.repeat(values[:, :, None], 3, axis=2) if kind == 3 else values
    peak = "" if kind == 1 else "1\n"
    text = f"P{kind} # comment\n3 2 {peak}" + " ".join(map(str, values.ravel())) + "\n"
    binary = np.packbits(values.astype(bool), axis=1).tobytes() if kind == 1 else values.astype(np.uint8).tobytes()
    packed = f"P{kind + 3} 3 2{' 1' if peak else ''}\n".encode() + binary
    for image in (read_header(text.encode()), read_header(packed)):
        np.testing.assert_array_equal(image.decode() > 0, (values > 0) != (kind == 1))
    for cut in (text.encode()[: -8 if kind == 1 else -5], packed[:-1]):
        with pytest.raises(ValueError, match="PNM ends early"):
            read_header(cut).decode()


@pytest.mark.parametrize("start", [b"BM\0\0ftypavif", b"\0\0\0\x1cftypavif", b"GIF89a", b"#?RADIANCE", b"v/1\x01"])
def test_formats_that_opencv_would_sniff_are_not_decoded(tmp_path, start, decoded):
    (tmp_path / "a.png").write_bytes(start + bytes(200))
    with pytest.raises(InputError, match="no image that can be read"):
        read_image(tmp_path / "a.png")
    assert decoded == []
