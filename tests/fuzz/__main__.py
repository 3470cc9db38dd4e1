"""`python -m tests.fuzz [KIND ...] [--count N] [--first N]`: the table of `docs/reliability.md`."""

import argparse

from tests.fuzz.kinds import KINDS
from tests.fuzz.running import fuzz


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("kinds", nargs="*", default=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--count", type=int, default=10_000, help="inputs of each kind (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first input (default: %(default)s)")
    options = parser.parse_args()
    print("| file | inputs | read | refused | slowest [s] | memory [MiB] | failures |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for kind in options.kinds:
        outcome = fuzz({kind: options.count}, first=options.first)[kind]
        cells = (outcome.inputs, outcome.read, outcome.refused, f"{outcome.slowest:.2f}", outcome.memory // 2**20)
        print(f"| {kind} | {' | '.join(map(str, cells))} | {len(outcome.failures)} |", flush=True)
        for number, failure in list(outcome.failures.items())[:10]:
            print(f"  {kind} {number}: {failure}", flush=True)


if __name__ == "__main__":
    main()
