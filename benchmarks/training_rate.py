"""How many pairs a second training takes: `stereokit train` beside a plain step of the same network.

    python benchmarks/training_rate.py
    python benchmarks/training_rate.py --compile --precision float32 bfloat16

The rival is the straightforward step: the network as built, in the default memory format; loss, backward, clipping and
Adam. Ours is that of `stereokit train`, less the average of the weights and the look for what is not finite. All have
the batch in memory and see the same pairs. Each form has a process of its own, and they take turns.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor
from turns import serve, take_turns

from stereokit import StereoKitError, build_model
from stereokit.losses import stereo_loss
from stereokit.model import StereoModel
from stereokit.optimize import keep_freed_memory, prepare_for_training

PRECISIONS = ("float32", "bfloat16")
RIVAL = "plain, float32"


def forms(options: argparse.Namespace) -> list[str]:
    kinds = ["plain", "ours", *(["ours, compiled"] if options.compile else [])]
    return [f"{kind}, {precision}" for precision in options.precision for kind in kinds]


def step(options: argparse.Namespace) -> Callable[[], None]:
    """One step of the form that this process is for."""
    kind, precision = options.worker.rsplit(", ", 1)
    torch.manual_seed(0)
    device = torch.device(options.device)
    model: StereoModel = build_model(options.model, max_disparity=options.max_disparity).to(device)
    if kind != "plain":
        keep_freed_memory()
        model = prepare_for_training(model)
    network = torch.compile(model) if kind == "ours, compiled" else model
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-4)
    height, width = options.size
    left, right = (torch.rand(options.batch, 3, height, width, device=device) for _ in range(2))
    truth: Tensor = torch.rand(options.batch, height, width, device=device) * options.max_disparity / 2

    def run() -> None:
        optimiser.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
            output = network(left, right)
        loss = stereo_loss(output, truth, auxiliary_weights=model.auxiliary_weights)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()

    return run


def work(options: argparse.Namespace) -> None:
    run = step(options)
    start = time.perf_counter()
    run()
    first = time.perf_counter() - start
    run()
    serve(first, run)


def compare(options: argparse.Namespace) -> None:
    height, width = options.size
    print(
        f"{options.model}, D = {options.max_disparity}, {options.batch} pairs of {height} x {width}, {options.device}, "
        f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}, torch {torch.__version__}, "
        f"load {os.getloadavg()[0]:.1f}",
        flush=True,
    )
    firsts, medians = take_turns(forms(options), options.rounds, lambda form: ["--worker", form])
    rival = medians.get(RIVAL, next(iter(medians.values())))
    print(f"load at the end {os.getloadavg()[0]:.1f}\n")
    print("| form | step [s] | pairs/s | times the first | by the processor's time | first step [s] |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for form, seconds in medians.items():
        wall, processor = rival / seconds
        row = f"{seconds[0]:.2f} | {options.batch / seconds[0]:.2f} | {wall:.2f} | {processor:.2f}"
        print(f"| {form} | {row} | {firsts[form]:.1f} |")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="coex")
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--size", nargs=2, type=int, default=(192, 384), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--precision", nargs="+", default=["float32"], choices=PRECISIONS)
    parser.add_argument("--compile", action="store_true", help="torch.compile too: minutes before it starts")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    try:
        if options.worker:
            work(options)
        else:
            compare(options)
    except StereoKitError as error:
        print(f"training_rate: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
