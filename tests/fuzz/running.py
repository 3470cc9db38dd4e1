"""Damaged files read in child processes, which may die of them."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Outcome", "fuzz"]

MEMORY_FOLDER = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Where files cost no disk access, which takes longer than all else."""

SILENCE = 300
"""Seconds without a new input after which a child hangs: far above what the child itself allows, for busy machines."""


@dataclass
class Outcome:
    """What a kind made of its inputs.

    Attributes:
        inputs: how many were tried.
        read: how many gave a result.
        refused: how many gave an error of the library.
        slowest: processor time of the slowest, in seconds.
        memory: that the process grew by, in bytes.
        failures: number of the input, and what went wrong.
        digest: of all that was seen.
    """

    inputs: int
    read: int = 0
    refused: int = 0
    slowest: float = 0.0
    memory: int = 0
    failures: dict[int, str] = field(default_factory=dict)
    digest: str = ""


def fuzz(counts: Mapping[str, int], *, first: int = 0, perturb: int | None = None) -> dict[str, Outcome]:
    """Tries the inputs `first` to `first + count - 1` of each kind.

    Args:
        counts: how many inputs, by names of `tests.fuzz.kinds.KINDS`.
        first: number of the first.
        perturb: what freed and fresh memory is filled with (glibc's MALLOC_PERTURB_), so that two runs show whether a
            result depends on it.
    """
    outcomes = {kind: Outcome(count) for kind, count in counts.items()}
    jobs = {kind: (first, count) for kind, count in counts.items()}
    while jobs:
        with tempfile.TemporaryDirectory(dir=MEMORY_FOLDER) as folder:
            died = _run_child(Path(folder), jobs, perturb)
            found = Path(folder, "found")
            for kind, seen in (json.loads(found.read_text()) if found.exists() else {}).items():
                outcome = outcomes[kind]
                outcome.read += seen["read"]
                outcome.refused += seen["refused"]
                outcome.slowest = max(outcome.slowest, seen["slowest"])
                outcome.memory = max(outcome.memory, seen["memory"])
                outcome.failures.update({int(number): failure for number, failure in seen["failures"].items()})
                outcome.digest += seen["digest"]
                del jobs[kind]
        if died is None:
            break
        kind, number, reason = died
        outcomes[kind].failures[number] = reason
        end = sum(jobs[kind])
        jobs[kind] = (number + 1, end - number - 1)
    return outcomes


def _run_child(folder: Path, jobs: Mapping[str, tuple[int, int]], perturb: int | None) -> tuple[str, int, str] | None:
    """None, or what the child died of: kind and number of the input, and the reason."""
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    if perturb is not None:
        environment["MALLOC_PERTURB_"] = str(perturb)
    words = [f"{kind}:{first}:{count}" for kind, (first, count) in jobs.items()]
    at, seen, silent = folder / "at", "", 0
    with open(folder / "said", "w+b") as said:
        command = [sys.executable, "-m", "tests.fuzz.child", str(folder), *words]
        child = subprocess.Popen(command, stdout=said, stderr=said, env=environment)
        while True:
            try:
                code = child.wait(timeout=10)
                break
            except subprocess.TimeoutExpired:
                now = at.read_text() if at.exists() else ""
                silent, seen = 0 if now != seen else silent + 10, now
                if silent >= SILENCE:
                    child.kill()
        said.seek(0)
        tail = said.read()[-400:].decode(errors="replace")
    if code == 0:
        return None
    if not at.exists():
        raise RuntimeError(f"the child did not begin: {tail}")
    kind, number = at.read_text().split()
    return kind, int(number), f"ended with {code}: {tail}"
