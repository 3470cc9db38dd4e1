"""Images of any kind a user may hold, to what a network takes."""

import os
from typing import Any, TypeAlias, Union

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from stereokit.data.images import read_image
from stereokit.errors import InputError
from stereokit.layers.casting import as_float

__all__ = ["ImageLike", "as_array", "to_image_tensor", "to_pair"]

ImageLike: TypeAlias = Union[str, "os.PathLike[str]", npt.NDArray[Any], Tensor, Any]
"""A path, an array (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), a tensor (H, W), (1, H, W), (3, H, W) or
(1, 3, H, W), or a PIL image, whose "I" modes hold 16 bits. uint8, uint16, or floating-point in [0, 1]; RGB."""

EXPECTED = "a path, an array (H, W, 3) or (H, W), a tensor (3, H, W) or (H, W), or a PIL image"


def to_image_tensor(image: ImageLike, name: str = "image") -> Tensor:
    """One image as a tensor.

    Grey is repeated in the three channels, an alpha channel is dropped, 16 bits become floating-point in [0, 1].

    Args:
        image: see `ImageLike`.
        name: what messages call it.

    Returns:
        (1, 3, H, W), uint8 or float32, RGB.

    Raises:
        InputError: an unreadable file, another shape or type, NaN or infinite pixels, or values outside [0, 1].

    >>> to_image_tensor(np.zeros((4, 6), np.uint16)).shape
    torch.Size([1, 3, 4, 6])
    """
    if isinstance(image, str | os.PathLike):
        return _from_array(read_image(image), f"the {name} image {os.fspath(image)!r}")
    name = f"the {name} image"
    if isinstance(image, Tensor):
        return _from_array(_channels_last(image, name), name)
    if hasattr(image, "getbands") and hasattr(image, "convert"):
        return _from_array(_from_pil(image, name), name)
    if isinstance(image, np.ndarray):
        return _from_array(image, name)
    raise InputError(f"{name} is {type(image).__name__}; expected {EXPECTED}")


def to_pair(left: ImageLike, right: ImageLike) -> tuple[Tensor, Tensor]:
    """A rectified pair as two tensors of one shape and type.

    Returns:
        Two (1, 3, H, W), both uint8 or both float32.

    Raises:
        InputError: see `to_image_tensor`; or the two differ in size.

    >>> to_pair(np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.float32))[0].dtype
    torch.float32
    """
    left, right = to_image_tensor(left, "left"), to_image_tensor(right, "right")
    if left.shape != right.shape:
        (lh, lw), (rh, rw) = left.shape[-2:], right.shape[-2:]
        raise InputError(
            f"the left image is {lw} x {lh} pixels, the right one {rw} x {rh}; a rectified pair has one size"
        )
    if left.dtype != right.dtype:
        left, right = as_float(left), as_float(right)
    return left, right


def as_array(values: Any) -> npt.NDArray[Any]:
    """A numpy array of an array or of a tensor, wherever the tensor lives; floating-point tensors become float32.

    >>> as_array(torch.ones(2, dtype=torch.bfloat16))
    array([1., 1.], dtype=float32)
    """
    if isinstance(values, Tensor):
        values = values.detach().cpu()
        # numpy has no bfloat16
        values = values.float() if values.is_floating_point() else values
    return np.asarray(values)


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


def _from_array(array: npt.NDArray[Any], name: str) -> Tensor:
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or array.size == 0:
        raise InputError(f"{name} has shape {array.shape}; expected (H, W), (H, W, 1), (H, W, 3) or (H, W, 4)")
    array = array[:, :, :3]
    if array.dtype.kind == "u" and array.dtype.itemsize == 2:
        array = array.astype(np.float32) / 65535
    elif np.issubdtype(array.dtype, np.floating):
        array = array.astype(np.float32)
        _check_range(array, name)
    elif array.dtype != np.uint8:
        raise InputError(f"{name} holds {array.dtype}; expected uint8, uint16, or floating-point in [0, 1]")
    # a copy: arrays may be read-only, and torch shares their memory
    planes = torch.from_numpy(np.array(np.moveaxis(array, 2, 0), order="C"))
    return planes.expand(3, -1, -1).contiguous().unsqueeze(0)


def _check_range(array: npt.NDArray[np.float32], name: str) -> None:
    bad = np.count_nonzero(~np.isfinite(array))
    if bad:
        raise InputError(f"{name} has {bad} values that are NaN or infinite; expected finite ones in [0, 1]")
    low, high = float(array.min()), float(array.max())
    # resizing filters overshoot a little
    if low < -0.05 or high > 1.05:
        hint = "; divide by 255, or pass uint8" if high > 2 else ""
        raise InputError(f"{name} is floating-point from {low:g} to {high:g}; expected [0, 1]{hint}")
