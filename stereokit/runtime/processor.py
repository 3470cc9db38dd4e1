"""What the processor and oneDNN can do, found out when it is first asked for."""

from functools import cache

import torch

__all__ = ["compiles_transposed", "cpu_has", "onednn_types"]


@cache
def cpu_has(dtype: torch.dtype) -> bool:
    """Whether oneDNN is here, and the processor has instructions for convolutions of this type."""
    operators = torch.ops.mkldnn
    available = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    if not available or not hasattr(operators, "_convolution_pointwise"):
        return False
    names = {torch.bfloat16: "_is_mkldnn_bf16_supported", torch.float16: "_is_mkldnn_fp16_supported"}
    return dtype == torch.float32 or (dtype in names and bool(getattr(operators, names[dtype])()))


@cache
def compiles_transposed() -> bool:
    """Whether the compiler is told the right size of oneDNN's transposed convolutions: not by PyTorch 2.14."""
    if not cpu_has(torch.float32):
        return False
    x, weight = torch.empty(1, 2, 3, 3, device="meta"), torch.empty(2, 5, 2, 2, device="meta")
    zeros, ones = [0, 0], [1, 1]
    size = torch.ops.mkldnn._convolution_transpose_pointwise(
        x, weight, None, zeros, zeros, ones, ones, 1, "none", [], ""
    ).shape
    return tuple(size) == (1, 5, 4, 4)


@cache
def onednn_types() -> frozenset[torch.dtype]:
    """The types of which oneDNN has fast convolutions here."""
    return frozenset(filter(cpu_has, (torch.float32, torch.bfloat16, torch.float16)))
