"""How many synthetic scenes one core renders a second.

    OMP_NUM_THREADS=1 python benchmarks/synthetic_rate.py

It prints the median over the scenes of 1 / seconds, and the mean. 15 of 256 x 512 is what loaders need to keep up.
"""

import argparse
import time

import cv2
import numpy as np

from stereokit.data.synthetic import SyntheticScenes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--size", nargs=2, type=int, default=(256, 512), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--max-disparity", type=float, default=96.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--textures", help="folder of photographs")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    start = time.perf_counter()
    scenes = SyntheticScenes(
        seed=options.seed, size=tuple(options.size), max_disparity=options.max_disparity, textures=options.textures
    )
    print(f"texture bank: {time.perf_counter() - start:.1f} s")
    seconds = []
    for index in range(options.scenes):
        start = time.perf_counter()
        scenes[index]
        seconds.append(time.perf_counter() - start)
    height, width = options.size
    print(
        f"{options.scenes} scenes of {height} x {width} on one core: "
        f"median {1 / np.median(seconds):.1f} scenes/s, mean {1 / np.mean(seconds):.1f} scenes/s, "
        f"slowest {max(seconds) * 1000:.0f} ms"
    )


if __name__ == "__main__":
    main()
