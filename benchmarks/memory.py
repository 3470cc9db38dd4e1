"""The memory that a pair takes, against what `estimate_memory` finds for the network in plain PyTorch.

    stereokit export --to onnx --out coex.onnx
    stereokit export --to openvino --out coex.xml
    python benchmarks/memory.py coex psmnet coex.onnx coex.xml --size 384 1248 --size 768 1248

Networks run as they were written (--backend eager), or made ready for inference, as `Predictor` runs them. Each point
runs in a process of its own. The shares of exported files are what `memory_share` of their backends bounds.
"""

import argparse
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch

from stereokit import StereoKitError, build_model
from stereokit.backends import open_backend
from stereokit.backends.exported import ExportedBackend
from stereokit.runtime.memory import estimate_memory, format_memory
from stereokit.runtime.memory.peak import PeakMemory
from stereokit.tables import Table
from stereokit.weights.places import is_exported

SIZES = ((384, 1248), (768, 1248))


def measure(name: str, height: int, width: int, backend: str) -> tuple[int, int]:
    """Bytes that were estimated, and that a pair took."""
    generator = torch.Generator().manual_seed(0)
    left, right = torch.randint(256, (2, 1, 3, height, width), dtype=torch.uint8, generator=generator)
    with torch.inference_mode():
        run: Any
        if is_exported(name):
            run = open_backend(name, "cpu")
            assert isinstance(run, ExportedBackend)
            network = run.as_module()
        else:
            run = network = build_model(name).eval()
            if backend != "eager":
                run = open_backend(network, "cpu", backend)
                run.prepare(left, right)
        estimated = estimate_memory(network, height, width)
        peak = PeakMemory("cpu")
        run(left, right)
        taken = peak.bytes()
    if taken is None:
        raise StereoKitError("this system does not tell how much memory a process took; Linux does")
    return estimated, taken


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", help="networks, and files exported for any size")
    parser.add_argument("--size", nargs=2, type=int, action="append", metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--backend", default="torch", choices=("eager", "torch"), help="of networks (default: torch)")
    options = parser.parse_args()
    rows = []
    for name in options.names:
        for height, width in options.size or SIZES:
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                try:
                    estimated, taken = pool.submit(measure, name, height, width, options.backend).result()
                except BrokenProcessPool:
                    rows.append((name, f"{height} x {width}", "-", "the system ended the process", "-"))
                    continue
                except StereoKitError as error:
                    print(f"memory: {error}", file=sys.stderr)
                    return 2
            sizes = (format_memory(estimated), format_memory(taken))
            rows.append((name, f"{height} x {width}", *sizes, f"{taken / estimated:.2f}"))
    print(Table(("name", "size", "estimated", "taken", "share"), tuple(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
