"""What the hardware can do, measured on the spot."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from stereokit.runtime.clock import Clock, synchronised_clock
from stereokit.runtime.precision import DTYPES

__all__ = ["Budget", "measure_budget"]

LARGEST = 8192
LONG_ENOUGH = 0.05
"""Seconds that one product should take, so that starting it counts for nothing."""
COPY_BYTES = 1 << 28
RUNS = 7


@dataclass(frozen=True)
class Budget:
    """Peaks of a device.

    Args:
        device: where they were measured.
        flops: floating-point operations a second of a large matrix product, by precision; a multiply-add is two.
        copy_bytes: bytes a second that copying within its memory reads and writes.
    """

    device: str
    flops: dict[str, float]
    copy_bytes: float

    def share(self, multiply_adds: int, seconds: float, precision: str) -> float | None:
        """The part of the peak that so many multiply-adds in so many seconds reach; None for an unknown precision.

        >>> Budget("cpu", {"float32": 1e9}, 1e9).share(250_000_000, seconds=1, precision="float32")
        0.5
        """
        peak = self.flops.get(precision)
        return None if peak is None else 2 * multiply_adds / seconds / peak


def measure_budget(
    device: str | torch.device, precisions: Sequence[str] = ("float32",), *, clock: Clock = synchronised_clock
) -> Budget:
    """Times a matrix product in each precision and a copy of 256 MiB; the fastest of seven runs counts.

    The matrices grow, up to 8192 x 8192, until a product takes a twentieth of a second. On CUDA the float32 product
    uses TF32 where convolutions do, as they do by default.

    Args:
        device: to be measured.
        precisions: of `stereokit.runtime.precision.DTYPES`; one that the device lacks is left out.
        clock: waits for the device.
    """
    device = torch.device(device)
    flops = {}
    for precision in precisions:
        try:
            flops[precision] = _matrix_product(device, DTYPES[precision], clock)
        except (KeyError, RuntimeError):
            # int8 and the like have no product here
            continue
    return Budget(str(device), flops, _copy(device, clock))


def _matrix_product(device: torch.device, dtype: torch.dtype, clock: Clock) -> float:
    size = 256
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda" and torch.backends.cudnn.allow_tf32:
        torch.set_float32_matmul_precision("high")
    try:
        while True:
            a, b = (torch.rand(size, size, device=device).to(dtype) for _ in range(2))
            a @ b
            start = clock()
            a @ b
            once = clock() - start
            if once >= LONG_ENOUGH or size == LARGEST:
                break
            size *= 2
        seconds = [once]
        for _ in range(RUNS - 1):
            start = clock()
            a @ b
            seconds.append(clock() - start)
    finally:
        torch.set_float32_matmul_precision(before)
    return 2.0 * size**3 / min(seconds)


def _copy(device: torch.device, clock: Clock) -> float:
    source = torch.ones(COPY_BYTES // 4, device=device)
    target = torch.empty_like(source).copy_(source)
    seconds = []
    for _ in range(RUNS):
        start = clock()
        target.copy_(source)
        seconds.append(clock() - start)
    return 2.0 * COPY_BYTES / min(seconds)
