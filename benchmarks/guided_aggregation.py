"""Time and peak memory, forward and backward, of GANet's two aggregations: SGA and LGA beside their plain forms.

    python benchmarks/guided_aggregation.py
    python benchmarks/guided_aggregation.py --device cuda --size 384 1248 --max-disparity 192

The plain SGA goes row by row too, but leaves the gradient to autograd, which keeps what each row needs; the plain LGA
unfolds the 25 neighbours of each pixel. Each runs in a process of its own, all of them in turns. Sizes are those of the
image: SGA sees a third of it with 32 channels, LGA all of it.
"""

import argparse
import sys
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F
from turns import serve, take_turns

from stereokit.guidance import semi_global_aggregate
from stereokit.regression import local_guided_aggregate
from stereokit.runtime.memory import PeakMemory

MIB = 2**20


def plain_semi_global(volume: Tensor, weights: Tensor) -> Tensor:
    """`semi_global_aggregate`, by autograd alone."""
    batch, channels, _, height, width = volume.shape
    weights = F.normalize(weights.reshape(batch, 4, channels, 5, height, width), p=1.0, dim=3)
    results = []
    for direction in range(4):
        x, w = volume, weights[:, direction].movedim(2, 0).unsqueeze(3)
        if direction >= 2:
            x, w = x.transpose(-1, -2), w.transpose(-1, -2)
        if direction % 2:
            x, w = x.flip(-2), w.flip(-2)
        rows = [x[..., 0, :] * w[..., 0, :].sum(0)]
        for y in range(1, x.shape[-2]):
            own, before = x[..., y, :], rows[-1]
            lower = torch.cat((own[:, :, :1], before[:, :, :-1]), dim=2)
            upper = torch.cat((before[:, :, 1:], own[:, :, -1:]), dim=2)
            best = before.amax(2, keepdim=True).expand_as(before)
            rows.append((torch.stack((own, before, lower, upper, best)) * w[..., y, :]).sum(0))
        result = torch.stack(rows, dim=-2)
        result = result.flip(-2) if direction % 2 else result
        results.append(result.transpose(-1, -2) if direction >= 2 else result)
    return torch.stack(results).amax(0)


def plain_local_guided(volume: Tensor, weights: Tensor) -> Tensor:
    """`local_guided_aggregate`, with unfolded copies."""
    planes, height, width = volume.shape[1:]
    weights = F.normalize(weights, p=1.0, dim=1).unflatten(1, (3, 25))
    ones = F.unfold(torch.ones_like(volume[:, :1]), 5, padding=2).unflatten(2, (height, width))
    copies = F.unfold(volume.flatten(0, 1).unsqueeze(1), 5, padding=2).unflatten(2, (height, width))
    copies = copies.unflatten(0, (-1, planes))
    total = torch.zeros_like(volume)
    for k in range(3):
        w = weights[:, k].unsqueeze(1)
        moved = F.pad(copies, (0, 0, 0, 0, 0, 0, 1, 1))[:, k : k + planes]
        inside = F.pad(ones.unsqueeze(1).expand_as(copies), (0, 0, 0, 0, 0, 0, 1, 1))[:, k : k + planes]
        total = total + (w * (moved + (1 - inside) * volume.unsqueeze(2))).sum(2)
    return total


FORMS: dict[str, tuple[Callable[[Tensor, Tensor], Tensor], str]] = {
    "SGA, plain": (plain_semi_global, "semi_global"),
    "SGA": (semi_global_aggregate, "semi_global"),
    "LGA, plain": (plain_local_guided, "local_guided"),
    "LGA": (local_guided_aggregate, "local_guided"),
}


def work(options: argparse.Namespace) -> None:
    """One form in a process of its own."""
    form, kind = FORMS[options.worker]
    height, width = options.size
    if kind == "semi_global":
        shape = (1, 32, options.max_disparity // 3 + 1, height // 3, width // 3)
        volume, weights = torch.rand(shape), torch.randn(1, 640, *shape[-2:])
    else:
        volume, weights = torch.rand(1, options.max_disparity + 1, height, width), torch.randn(1, 75, height, width)
    inputs = [x.to(options.device).requires_grad_() for x in (volume, weights)]

    def step() -> None:
        torch.autograd.grad(form(*inputs).sum(), inputs)

    def inference() -> None:
        with torch.inference_mode():
            form(*inputs)

    report = {}
    run = step if options.what == "training" else inference
    run()
    peak = PeakMemory(options.device)
    run()
    taken = peak.bytes()
    report["MiB"] = None if taken is None else round(taken / MIB)
    serve(report, run)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs=2, type=int, default=(96, 192), metavar=("H", "W"))
    parser.add_argument("--max-disparity", type=int, default=96)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--what", default="training", choices=["training", "inference"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--worker", choices=FORMS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.worker:
        work(options)
        return 0
    reports, times = take_turns(list(FORMS), options.rounds, lambda form: ["--worker", form])
    for form, (wall, cores) in times.items():
        print(f"{form:12} {1e3 * wall:9.0f} ms {1e3 * cores:9.0f} ms of cores {reports[form]['MiB']:>7} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
