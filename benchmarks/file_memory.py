"""The memory that exported files take for a pair, beside what PyTorch is estimated to take for the same network.

    stereokit export --to onnx --out coex.onnx
    stereokit export --to openvino --out coex.xml
    python benchmarks/file_memory.py coex.onnx coex.xml

Each point runs in a process of its own. The shares are what `memory_share` of the backends bounds.
"""

import argparse
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor

import torch

from stereokit import StereoKitError
from stereokit.backends import open_backend
from stereokit.benchmark.memory import PeakMemory
from stereokit.evaluation.tables import Table
from stereokit.memory import estimate_memory, format_memory

SIZES = ((384, 1248), (768, 1248), (1088, 1920))


def measure(path: str, height: int, width: int) -> tuple[int, int]:
    """Bytes that were estimated for PyTorch, and that the file took."""
    backend = open_backend(path, "cpu")
    estimated = estimate_memory(backend.as_module(), height, width)
    generator = torch.Generator().manual_seed(0)
    left, right = torch.randint(256, (2, 1, 3, height, width), dtype=torch.uint8, generator=generator)
    peak = PeakMemory("cpu")
    backend(left, right)
    taken = peak.bytes()
    if taken is None:
        raise StereoKitError("this system does not tell how much memory a process took; Linux does")
    return estimated, taken


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", help="exported for any size")
    rows = []
    try:
        for path in parser.parse_args().files:
            for height, width in SIZES:
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                    estimated, taken = pool.submit(measure, path, height, width).result()
                sizes = (format_memory(estimated), format_memory(taken))
                rows.append((path, f"{height} x {width}", *sizes, f"{taken / estimated:.2f}"))
    except StereoKitError as error:
        print(f"file_memory: {error}", file=sys.stderr)
        return 2
    print(Table(("file", "size", "PyTorch, estimated", "taken", "share"), tuple(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
