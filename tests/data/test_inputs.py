from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from stereokit import InputError
from stereokit.data import write_image
from stereokit.data.images import write_samples
from stereokit.data.inputs import as_array, to_image_tensor, to_pair

shapes = st.tuples(st.integers(1, 6), st.integers(1, 6))


@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 6), st.integers(1, 6), st.just(3))))
def test_every_kind_of_colour_image_gives_the_same_tensor(rgb: np.ndarray) -> None:
    expected = torch.from_numpy(rgb.copy()).permute(2, 0, 1).unsqueeze(0)
    alpha = np.full((*rgb.shape[:2], 1), 9, np.uint8)
    for image in (
        rgb,
        np.concatenate((rgb, alpha), axis=2),
        rgb[:, ::-1][:, ::-1],
        expected,
        expected[0],
        Image.fromarray(rgb),
        Image.fromarray(rgb).convert("RGBA"),
    ):
        assert torch.equal(to_image_tensor(image), expected)


@given(hnp.arrays(np.uint8, shapes))
def test_grey_is_repeated_in_the_three_channels(grey: np.ndarray) -> None:
    tensor = torch.from_numpy(grey.copy())
    expected = tensor.expand(1, 3, -1, -1)
    for image in (grey, grey[:, :, None], tensor, tensor[None], Image.fromarray(grey)):
        assert torch.equal(to_image_tensor(image), expected)


@given(hnp.arrays(np.uint16, shapes))
def test_sixteen_bits_become_floating_point(grey: np.ndarray) -> None:
    expected = torch.from_numpy(grey.astype(np.float32) / 65535).expand(1, 3, -1, -1)
    assert torch.equal(to_image_tensor(grey), expected)
    assert torch.equal(to_image_tensor(Image.fromarray(grey)), expected)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floating_point_keeps_its_values(dtype: type) -> None:
    image = np.linspace(0, 1, 24).reshape(2, 4, 3).astype(dtype)
    tensor = to_image_tensor(image)
    assert tensor.dtype == torch.float32
    np.testing.assert_allclose(tensor[0].permute(1, 2, 0), image, rtol=1e-3)
    assert torch.equal(to_image_tensor(torch.from_numpy(image).permute(2, 0, 1)), tensor)


def test_a_path_is_read_as_rgb(tmp_path: Path) -> None:
    rgb = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    write_image(tmp_path / "image.png", rgb)
    for path in (tmp_path / "image.png", str(tmp_path / "image.png")):
        assert torch.equal(to_image_tensor(path)[0].permute(1, 2, 0), torch.from_numpy(rgb))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 4, 2), np.uint8), r"shape \(4, 4, 2\)"),
        (np.zeros((2, 4, 4, 3), np.uint8), "shape"),
        (np.zeros((0, 4, 3), np.uint8), "shape"),
        (np.zeros((4, 4), np.int64), "int64"),
        (np.zeros((4, 4), bool), "bool"),
        (np.full((4, 4), np.nan, np.float32), "16 values that are NaN or infinite"),
        (np.full((4, 4), np.inf, np.float32), "NaN or infinite"),
        (np.full((4, 4), 200.0, np.float32), "divide by 255"),
        (np.full((4, 4), -1.0, np.float32), r"from -1 to -1; expected \[0, 1\]"),
        (torch.zeros(2, 3, 4, 4), r"tensor of shape \(2, 3, 4, 4\)"),
        (torch.zeros(4, 4, 3), "tensor of shape"),
        (torch.zeros(3, 4, 4).to_sparse(), "is sparse; expected a plain tensor"),
        (torch.zeros(3, 4, 4, device="meta"), "lies on the meta device"),
        (torch.zeros(3, 4, 4, dtype=torch.complex64), "complex64"),
        (b"left.png", "is bytes; expected"),
        ([[1, 2]], "is list; expected"),
        (None, "is NoneType; expected"),
    ],
)
def test_what_is_no_image_is_refused(image: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        to_image_tensor(image)


def test_pil_images_of_other_modes_keep_their_values() -> None:
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    np.testing.assert_array_equal(to_image_tensor(Image.fromarray(values))[0, 0], values)
    wide = Image.fromarray(np.array([[0, 65535], [7, 9]], np.int32))
    assert torch.equal(to_image_tensor(wide)[0, 0], torch.tensor([[0, 65535], [7, 9]]) / 65535)
    for value in (-1, 65536):
        with pytest.raises(InputError, match="expected 16 bits"):
            to_image_tensor(Image.fromarray(np.full((3, 4), value, np.int32)))


def test_byte_order_does_not_matter() -> None:
    values = np.array([[0, 65535], [7, 9]], np.uint16)
    assert torch.equal(to_image_tensor(values.astype(">u2")), to_image_tensor(values))


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    for path in (tmp_path / "absent.png", tmp_path / "text.png", tmp_path):
        with pytest.raises(InputError, match=path.name):
            to_image_tensor(path)


def test_a_pair_has_one_size_and_one_type() -> None:
    with pytest.raises(InputError, match="left image is 4 x 3 pixels, the right one 4 x 5"):
        to_pair(np.zeros((3, 4), np.uint8), np.zeros((5, 4), np.uint8))
    left, right = to_pair(np.full((3, 4), 51, np.uint8), np.full((3, 4), 0.2, np.float32))
    assert torch.allclose(left, right)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("left.png", "got 'left.png'; expected an array"),
        (Path("left.png"), "got 'left.png'; expected an array"),
        ([[1], [1, 2]], "got a list of rows that are not alike; expected an array"),
        (b"left.png", "got b'left.png'; expected an array"),
        (torch.zeros(2, device="meta"), "meta device"),
        (torch.zeros(2, 2).to_sparse(), "the tensor is sparse"),
    ],
)
def test_what_is_no_array(values: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_array(values)


@pytest.mark.filterwarnings("ignore")
def test_a_quantised_tensor_is_refused() -> None:
    with pytest.raises(InputError, match="is quantised; expected a plain tensor"):
        to_image_tensor(torch.quantize_per_tensor(torch.zeros(3, 4, 4), 1, 0, torch.quint8))


def test_bit_depth_of_every_kind_of_image(tmp_path: Path) -> None:
    deep = np.array([[0, 2048, 4095]], np.uint16)
    expected = torch.from_numpy((deep / 4095).astype(np.float32)).expand(1, 3, -1, -1)
    write_samples(tmp_path / "deep.png", deep, overwrite=False)
    for image in (deep, torch.from_numpy(deep), Image.fromarray(deep), deep.astype(np.float32), tmp_path / "deep.png"):
        torch.testing.assert_close(to_image_tensor(image, bit_depth=12), expected)
    for image in (deep.astype(np.float32) / 4095, -deep.astype(np.float32)):
        with pytest.raises(InputError, match=r"bit_depth=12 takes values from 0 to 4095, some above 1"):
            to_image_tensor(image, bit_depth=12)
    with pytest.raises(InputError, match="whole number from 1 to 16, got 99"):
        to_image_tensor(deep, bit_depth=99)


def test_the_same_image_twice_is_warned_of(recwarn: pytest.WarningsRecorder) -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8)
    other = image.copy()
    other[3, 4, 2] ^= 1
    to_pair(image, other)
    # of one colour all over, which a covered lens sees too
    to_pair(np.full_like(image, 7), np.full_like(image, 7))
    assert not recwarn
    with pytest.warns(UserWarning, match="the left image and the right image are the same: give the views of both"):
        to_pair(image, image / 255)


def test_bit_depth_of_a_pair_is_that_of_its_deep_views() -> None:
    deep, flat = np.full((4, 5), 4095, np.uint16), np.full((4, 5), 255, np.uint8)
    with pytest.warns(UserWarning, match="one image of a pair has 8 bits per sample, the other more"):
        left, right = to_pair(flat, deep, bit_depth=12)
    assert torch.equal(left, right)
    with pytest.raises(InputError, match="both images have 8 bits per sample: leave out bit_depth=12"):
        to_pair(flat, flat, bit_depth=12)
    assert to_pair(flat, flat, bit_depth=8)[0].dtype == torch.uint8
