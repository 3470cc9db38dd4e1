"""Learned cost volumes, all planes together, beside the published loop over the disparities.

    python benchmarks/learned_volumes.py
    python benchmarks/learned_volumes.py --device cuda --size 384 1248 --rounds 9

The forms take turns in one process; their volumes are compared first. "step" is forward and backward in training mode,
in which the published interlaced volume normalises each disparity by itself, so that it alone is not compared there.
"""

import argparse
from collections.abc import Callable

import torch
from torch import Tensor, nn

from stereokit import InterlacedVolume, MatchingNetwork
from stereokit.runtime.clock import Timing, time_interleaved


def interlaced_loop(cost: InterlacedVolume, left: Tensor, right: Tensor) -> Tensor:
    """`InterlacedVolume`, one disparity after the other, on the columns that both views see."""
    left, right = cost.reduction(left), cost.reduction(right)
    width = left.shape[-1]
    volume = left.new_zeros(len(left), 1, cost.planes, *left.shape[2:])
    for d in range(cost.planes):
        x = torch.stack((left[..., d:], right[..., : width - d]), dim=2).flatten(1, 2).unsqueeze(1)
        for layer in cost.layers:
            x = layer.activation(layer.norm(layer.conv(x)))
        volume[:, :, d, :, d:] = cost.merge.activation(cost.merge.norm(cost.merge.conv(x.squeeze(2))))
    return volume


def matching_loop(cost: MatchingNetwork, left: Tensor, right: Tensor) -> Tensor:
    """`MatchingNetwork`, one disparity after the other, on both views concatenated."""
    weight = torch.cat((cost.of_left.weight, cost.of_right.weight), dim=1)
    width, planes = left.shape[-1], []
    for d in range(cost.planes):
        shifted = nn.functional.pad(right[..., : width - d], (d, 0))
        x = nn.functional.conv2d(torch.cat((left, shifted), dim=1), weight, cost.of_left.bias, padding=1)
        planes.append(cost.head(cost.blocks(x)))
    return torch.stack(planes, dim=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", type=int, nargs=2, default=[256, 512], metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--max-disparity", type=int, default=192)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    print("| volume | together [ms] | loop [ms] | loop / together |\n|---|---:|---:|---:|")
    compare("interlaced", InterlacedVolume, 320, interlaced_loop, options)
    compare("matching_network", MatchingNetwork, 64, matching_loop, options)


def compare(
    name: str, kind: Callable[..., nn.Module], channels: int, loop: Callable[..., Tensor], options: argparse.Namespace
) -> None:
    """Two rows of the table: inference, and a step of training."""
    height, width = (side // 4 for side in options.size)
    cost = kind(in_channels=channels, planes=options.max_disparity // 4).to(options.device).eval()
    maps = torch.rand(2, 1, channels, height, width, device=options.device)
    with torch.inference_mode():
        # this warms them up too
        torch.testing.assert_close(cost(*maps), loop(cost, *maps), rtol=1e-3, atol=1e-3)
        report(
            name,
            time_interleaved(
                {"together": lambda: cost(*maps), "loop": lambda: loop(cost, *maps)}, repeats=options.rounds
            ),
        )
    cost.train()
    steps = {"together": lambda: cost(*maps).sum().backward(), "loop": lambda: loop(cost, *maps).sum().backward()}
    report(f"{name}, step", time_interleaved(steps, repeats=options.rounds))


def report(name: str, timings: dict[str, Timing | Exception]) -> None:
    """A row of the table."""
    together, loop = (1000 * timings[form].median for form in ("together", "loop"))
    print(f"| {name} | {together:.0f} | {loop:.0f} | {loop / together:.2f} |", flush=True)


if __name__ == "__main__":
    main()
