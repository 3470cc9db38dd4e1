"""Types of numbers, where they matter."""

import torch
from torch import Tensor

__all__ = ["as_float", "at_least_float32"]


def as_float(images: Tensor) -> Tensor:
    """Images in [0, 1], whether they are uint8 or in [0, 1] already.

    >>> import torch
    >>> as_float(torch.tensor([0, 255], dtype=torch.uint8))
    tensor([0., 1.])
    """
    return images / 255 if images.dtype == torch.uint8 else images


def at_least_float32(x: Tensor) -> Tensor:
    """Half precision to single; float64 stays. For norms, distributions and disparities.

    Sums of squares overflow in float16, and bfloat16 has steps of half a pixel at 100.
    """
    return x.float() if x.dtype.itemsize == 2 else x
