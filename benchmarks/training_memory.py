"""Peak memory and time, forward and backward, of the correlation and of the superpixel upsampling.

    python benchmarks/training_memory.py
    python benchmarks/training_memory.py --device cuda --batch 8 --size 288 576

Each stands beside its plain form, which unfolds: all shifted features for the correlation, nine maps of full size for
the upsampling. Each runs in a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor
from torch.nn import functional as F

from stereokit.costs.shift import inner_products
from stereokit.runtime.clock import synchronised_clock
from stereokit.runtime.memory.peak import PeakMemory
from stereokit.upsampling.superpixel import superpixel_upsample

MIB = 2**20


def unfolded_products(left: Tensor, right: Tensor, levels: int) -> Tensor:
    """`inner_products` with all shifted right features stacked."""
    batch, channels, height, width = right.shape
    shifted = F.unfold(F.pad(right, (levels - 1, 0)), (1, width))
    shifted = shifted.reshape(batch, channels, width, height, levels).permute(0, 1, 4, 3, 2).flip(2)
    return (left.unsqueeze(2) * shifted).sum(1)


def ninefold_upsample(disparity: Tensor, weights: Tensor) -> Tensor:
    """`superpixel_upsample` of nine maps enlarged to full size."""
    height, width = disparity.shape[-2:]
    nine = F.unfold(F.pad(disparity.unsqueeze(1), (1, 1, 1, 1), mode="replicate"), 3)
    nine = nine.reshape(-1, 9, height, width)
    return (F.interpolate(nine, size=weights.shape[-2:], mode="nearest") * weights).sum(1)


def correlation(form: Callable[..., Tensor]) -> Callable[[argparse.Namespace], Callable[[], Tensor]]:
    def make(options: argparse.Namespace) -> Callable[[], Tensor]:
        height, width = (side // 4 for side in options.size)
        left, right = (
            torch.rand(options.batch, 48, height, width, device=options.device).requires_grad_() for _ in range(2)
        )
        return lambda: form(left, right, options.max_disparity // 4)

    return make


def upsampling(form: Callable[..., Tensor]) -> Callable[[argparse.Namespace], Callable[[], Tensor]]:
    def make(options: argparse.Namespace) -> Callable[[], Tensor]:
        height, width = options.size
        disparity = torch.rand(options.batch, height // 4, width // 4, device=options.device).requires_grad_()
        weights = torch.rand(options.batch, 9, height, width, device=options.device).requires_grad_()
        return lambda: form(disparity, weights)

    return make


CASES = {
    "correlation, unfolded": correlation(unfolded_products),
    "correlation": correlation(inner_products),
    "upsampling, ninefold": upsampling(ninefold_upsample),
    "upsampling": upsampling(superpixel_upsample),
}


def work(options: argparse.Namespace) -> None:
    """One case in a process of its own."""
    forward = CASES[options.worker](options)
    with torch.no_grad():
        gradient = torch.rand_like(forward())
    peak = PeakMemory(options.device)
    kept = 0
    storages = set()

    def note(tensor: Tensor) -> Tensor:
        nonlocal kept
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in storages:
            storages.add(storage.data_ptr())
            kept += storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        output = forward()
    output.backward(gradient)
    most = peak.bytes()
    del output
    times = []
    for _ in range(options.rounds):
        starts = synchronised_clock(), time.process_time()
        forward().backward(gradient)
        times.append((synchronised_clock() - starts[0], time.process_time() - starts[1]))
    wall, processor = (median(column) for column in zip(*times, strict=True))
    print(json.dumps([None if most is None else most / MIB, kept / MIB, wall, processor]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs=2, type=int, default=(288, 576), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--worker", choices=CASES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options)
        return
    height, width = options.size
    print(f"batch {options.batch}, {height} x {width}, D = {options.max_disparity}, {options.device}, ", end="")
    print(f"{torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}\n")
    print("| | peak [MiB] | saved for backward [MiB] | forward and backward [s] | processor [s] |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for case in CASES:
        command = [sys.executable, *sys.argv, "--worker", case]
        result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        most, kept, wall, processor = json.loads(result.stdout)
        print(
            f"| {case} | {'-' if most is None else format(most, '.0f')} | {kept:.0f} | {wall:.3f} | {processor:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
