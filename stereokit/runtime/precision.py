"""Names of the precisions that a network can compute in."""

import torch

from stereokit.errors import ConfigError

__all__ = ["DTYPES", "dtype_of"]

DTYPES: dict[str, torch.dtype] = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def dtype_of(precision: str) -> torch.dtype:
    """The type of that name.

    Raises:
        ConfigError: there is none.

    >>> dtype_of("bfloat16")
    torch.bfloat16
    """
    if precision not in DTYPES:
        raise ConfigError(f"precision={precision!r} is unknown; use {', '.join(DTYPES)}")
    return DTYPES[precision]
