"""How many pairs a second training takes: `stereokit train` beside a plain step of the same network.

    python benchmarks/training_rate.py --compile

The rival is the straightforward step: the network as built, in the default memory format; loss, backward, clipping and
Adam. Ours is what `stereokit train` runs between two batches. Both have the batch in memory, see the same pairs, and
take turns in one run; printed is the median over the turns.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from stereokit import build_model
from stereokit.losses import stereo_loss
from stereokit.model import StereoModel
from stereokit.optimize import prepare_for_training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="coex")
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--size", nargs=2, type=int, default=(192, 384), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--precision", nargs="+", default=["float32"], choices=("float32", "bfloat16"))
    parser.add_argument("--compile", action="store_true", help="torch.compile too: minutes before it starts")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    steps: dict[str, Callable[[], None]] = {}
    for precision in options.precision:
        steps[f"plain, {precision}"] = step(options, precision, prepared=False, compiled=False)
        steps[f"ours, {precision}"] = step(options, precision, prepared=True, compiled=False)
        if options.compile:
            steps[f"ours, compiled, {precision}"] = step(options, precision, prepared=True, compiled=True)
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for name, run in steps.items():
        start = time.perf_counter()
        run()
        print(f"{name}: first step {time.perf_counter() - start:.1f} s", flush=True)
    for _ in range(options.turns):
        for name, run in steps.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    rival = statistics.median(seconds[f"plain, {options.precision[0]}"])
    height, width = options.size
    print(
        f"{options.model}, D = {options.max_disparity}, {options.batch} pairs of {height} x {width}, {options.device}"
    )
    for name, times in seconds.items():
        median = statistics.median(times)
        print(f"{name}: {options.batch / median:.2f} pairs/s, {rival / median:.2f} times the first")


def step(options: argparse.Namespace, precision: str, *, prepared: bool, compiled: bool) -> Callable[[], None]:
    torch.manual_seed(0)
    device = torch.device(options.device)
    model: StereoModel = build_model(options.model, max_disparity=options.max_disparity).to(device)
    if prepared:
        prepare_for_training(model)
    network = torch.compile(model) if compiled else model
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
        if device.type == "cuda":
            torch.cuda.synchronize()

    return run


if __name__ == "__main__":
    main()
