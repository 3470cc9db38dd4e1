"""Images of any kind a user may hold, to what a network takes."""

import os
import warnings
from typing import Any, TypeAlias, Union

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from stereokit.data.bit_depth import check_bit_depth, to_rgb, warn_of_other_depths
from stereokit.data.images import read_stored
from stereokit.errors import InputError, printable
from stereokit.layers.casting import as_float

__all__ = ["ImageLike", "as_array", "to_image_tensor", "to_pair"]

ImageLike: TypeAlias = Union[str, "os.PathLike[str]", npt.NDArray[Any], Tensor, Any]
"""A path, an array (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), a tensor (H, W), (1, H, W), (3, H, W) or
(1, 3, H, W), or a PIL image, whose "I" modes hold 16 bits. uint8, uint16, or floating-point in [0, 1]; RGB."""

EXPECTED = "a path, an array (H, W, 3) or (H, W), a tensor (3, H, W) or (H, W), or a PIL image"


_Stored: TypeAlias = "tuple[npt.NDArray[Any], str, int | None]"


def to_image_tensor(image: ImageLike, name: str = "image", *, bit_depth: int | None = None) -> Tensor:
    """One image as a tensor.

    Grey is repeated in the three channels, an alpha channel is dropped, 16 bits become floating-point in [0, 1].

    Args:
        image: see `ImageLike`.
        name: what messages call it.
        bit_depth: the bits of the camera, where 16-bit or floating-point samples hold fewer: 12 for values to 4095.

    Returns:
        (1, 3, H, W), uint8 or float32, RGB.

    Raises:
        InputError: an unreadable file, another shape or type, NaN or infinite pixels, values outside [0, 1], or others
            than `bit_depth` says.

    Warns:
        UserWarning: see `to_rgb`.

    >>> to_image_tensor(np.zeros((4, 6), np.uint16)).shape
    torch.Size([1, 3, 4, 6])
    """
    check_bit_depth(bit_depth)
    return _to_tensor(_stored(image, name), bit_depth)


def to_pair(
    left: ImageLike, right: ImageLike, *, bit_depth: int | None = None, doubt: bool = True
) -> tuple[Tensor, Tensor]:
    """A rectified pair as two tensors of one shape and type.

    Args:
        left: see `ImageLike`.
        right: the same.
        bit_depth: of the views that have more than 8 bits per sample; see `to_image_tensor`.
        doubt: warn of the same image twice; it is done once, where views pass through here again.

    Returns:
        Two (1, 3, H, W), both uint8 or both float32.

    Raises:
        InputError: see `to_image_tensor`; or the two differ in size.

    Warns:
        UserWarning: one view has 8 bits per sample, the other 16; both are the same image; and see `to_rgb`.

    >>> to_pair(np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.float32))[0].dtype
    torch.float32
    """
    check_bit_depth(bit_depth)
    views = _stored(left, "left"), _stored(right, "right")
    samples = [view[0] for view in views]
    if {values.dtype.kind for values in samples} == {"u"}:
        warn_of_other_depths(*samples)
    if bit_depth not in (None, 8) and all(values.dtype == np.uint8 for values in samples):
        raise InputError(f"both images have 8 bits per sample: leave out bit_depth={bit_depth}")
    left, right = (_to_tensor(view, None if view[0].dtype == np.uint8 else bit_depth) for view in views)
    if left.shape != right.shape:
        (lh, lw), (rh, rw) = left.shape[-2:], right.shape[-2:]
        raise InputError(
            f"the left image is {lw} x {lh} pixels, the right one {rw} x {rh}; a rectified pair has one size"
        )
    if left.dtype != right.dtype:
        left, right = as_float(left), as_float(right)
    # one colour all over is the same of any camera that sees nothing
    if doubt and torch.equal(left, right) and bool((left != left[..., :1, :1]).any()):
        names = " and ".join(view[1] for view in views)
        warnings.warn(f"{names} are the same: give the views of both cameras", stacklevel=2)
    return left, right


def as_array(values: Any) -> npt.NDArray[Any]:
    """A numpy array of an array or of a tensor, wherever the tensor lives; floating-point tensors become float32.

    >>> as_array(torch.ones(2, dtype=torch.bfloat16))
    array([1., 1.], dtype=float32)
    """
    if isinstance(values, Tensor):
        _check_values(values, "the tensor")
        values = values.detach().cpu()
        # numpy has no bfloat16
        values = values.float() if values.is_floating_point() else values
    if isinstance(values, str | bytes | os.PathLike):
        raise InputError(f"got {printable(values)}; expected an array or a tensor of numbers")
    try:
        return np.asarray(values)
    except ValueError as error:
        raise InputError(f"got a {type(values).__name__} of rows that are not alike; expected an array") from error


def _check_values(tensor: Tensor, name: str) -> None:
    """Refuses tensors whose values can't be looked at one by one.

    Raises:
        InputError: a tensor on the meta device, or one that is sparse, nested or quantised.
    """
    if tensor.device.type == "meta":
        raise InputError(f"{name} lies on the meta device, which holds no values; make it on a CPU or a GPU")
    if tensor.is_nested or tensor.is_quantized or tensor.layout is not torch.strided:
        kind = "nested" if tensor.is_nested else "quantised" if tensor.is_quantized else "sparse"
        raise InputError(f"{name} is {kind}; expected a plain tensor, as its to_dense() or dequantize() gives")


def _stored(image: ImageLike, name: str) -> _Stored:
    """The samples of an image of any kind, what to call it, and which sample is white where the file says."""
    if isinstance(image, str | os.PathLike):
        samples, peak = read_stored(image)
        return samples, f"the {name} image {printable(image)}", peak
    name = f"the {name} image"
    if isinstance(image, Tensor):
        _check_values(image, name)
        return _channels_last(image, name), name, None
    if hasattr(image, "getbands") and hasattr(image, "convert"):
        return _from_pil(image, name), name, None
    if isinstance(image, np.ndarray):
        return image, name, None
    raise InputError(f"{name} is {type(image).__name__}; expected {EXPECTED}")


def _to_tensor(stored: _Stored, bit_depth: int | None) -> Tensor:
    samples, name, peak = stored
    rgb = to_rgb(samples, name, peak=peak, bit_depth=bit_depth)
    # a copy: arrays may be read-only, and torch shares their memory
    return torch.from_numpy(np.array(np.moveaxis(rgb, 2, 0), order="C")).unsqueeze(0)


def _channels_last(tensor: Tensor, name: str) -> npt.NDArray[Any]:
    if tensor.dim() == 4 and tensor.shape[0] == 1:
        tensor = tensor[0]
    if tensor.dim() == 3 and tensor.shape[0] in (1, 3):
        tensor = tensor.permute(1, 2, 0)
    elif tensor.dim() != 2:
        raise InputError(f"{name} is a tensor of shape {tuple(tensor.shape)}; expected (3, H, W), (1, H, W) or (H, W)")
    return as_array(tensor)


def _from_pil(image: Any, name: str) -> npt.NDArray[Any]:
    array = np.asarray(image)
    if image.mode == "F":
        return array
    if image.mode.startswith("I"):
        # Pillow opens 16-bit grey files in one of the "I" modes, some of them 32 bits wide
        if array.min() < 0 or array.max() > 65535:
            raise InputError(
                f"{name} is a PIL image of mode {image.mode!r} from {array.min()} to {array.max()}; "
                "expected 16 bits, 0 to 65535"
            )
        return array.astype(np.uint16)
    return array if image.mode in ("L", "RGB") else np.asarray(image.convert("RGB"))
