"""How many synthetic scenes one core renders a second.

    OMP_NUM_THREADS=1 python benchmarks/synthetic_rate.py

It prints the median over the scenes of 1 / seconds, and the mean; by the clock, and by the processor's time, which is
what a core to itself would take. 15 of 256 x 512 is what loaders need to keep up with a GPU.
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
    clocks = {"clock": time.perf_counter, "processor": time.process_time}
    seconds = np.empty((options.scenes, len(clocks)))
    for index in range(options.scenes):
        starts = [clock() for clock in clocks.values()]
        scenes[index]
        seconds[index] = [clock() - start for clock, start in zip(clocks.values(), starts, strict=True)]
    height, width = options.size
    print(f"{options.scenes} scenes of {height} x {width} on one core")
    for name, times in zip(clocks, seconds.T, strict=True):
        print(
            f"by the {name}: median {1 / np.median(times):.1f} scenes/s, mean {1 / times.mean():.1f} scenes/s, "
            f"slowest {times.max() * 1000:.0f} ms"
        )


if __name__ == "__main__":
    main()
