"""Reads damaged files in this process, which a reader may end. Its parent is `tests.fuzz.running`.

`python -m tests.fuzz.child FOLDER KIND:FIRST:COUNT ...`: before each input its kind and number are written to
FOLDER/at, and after each kind what was found to FOLDER/found.
"""

import hashlib
import json
import os
import resource
import signal
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stereokit.errors import StereoKitError
from tests.fuzz.kinds import KINDS, Kind

SECONDS = 5
MEMORY = 2**30
MESSAGE = 400


class Hangs(BaseException):
    """No reader catches it."""


def main() -> None:
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    signal.signal(signal.SIGPROF, _hang)
    folder = Path(sys.argv[1])
    found: dict[str, Any] = {}
    for job in sys.argv[2:]:
        kind, first, count = job.split(":")
        inputs = folder / kind
        inputs.mkdir()
        os.chdir(inputs)
        found[kind] = _try(KINDS[kind], kind, range(int(first), int(first) + int(count)), folder / "at", inputs)
        (folder / "found").write_text(json.dumps(found))


def _try(kind: Kind, name: str, numbers: range, at: Path, inputs: Path) -> dict[str, Any]:
    seeds = kind.seeds()
    for beside, content in kind.beside().items():
        (inputs / beside).write_bytes(content)
    path = inputs / kind.name
    for seed in seeds:
        # what is imported on the way is no one input's memory
        path.write_bytes(seed)
        _outcome(kind.read, path)
    before, listed = _peak(), sorted(os.listdir(inputs))
    found: dict[str, Any] = {"read": 0, "refused": 0, "slowest": 0.0, "memory": 0, "failures": {}}
    digest = hashlib.sha256()
    for number in numbers:
        at.write_text(f"{name} {number}")
        path.write_bytes(kind.input(seeds, number))
        peak, began = _peak(), time.process_time()
        what, failure, seen = _outcome(kind.read, path)
        seconds = time.process_time() - began
        # messages name the file, whose folder is another one every time
        digest.update(seen.replace(str(inputs).encode(), b""))
        found[what] += 1
        found["slowest"] = max(found["slowest"], seconds)
        found["memory"] = max(found["memory"], _peak() - before)
        if _peak() - before > MEMORY and _peak() > peak:
            failure = f"it took {(_peak() - before) // 2**20} MiB"
        if sorted(os.listdir(inputs)) != listed:
            failure = f"it wrote files: {sorted(os.listdir(inputs))}"
        if failure:
            found["failures"][number] = failure
    return {**found, "digest": digest.hexdigest()}


def _outcome(read: Any, path: Path) -> tuple[str, str | None, bytes]:
    """Whether it was read or refused, what is wrong with that, and what was seen."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        result = read(path)
        return "read", None, result.tobytes() if isinstance(result, np.ndarray) else repr(result).encode()
    except StereoKitError as error:
        message = str(error)
        wrong = None if message.isprintable() and 0 < len(message) < MESSAGE else f"the message is {message[:500]!r}"
        return "refused", wrong, message.encode("utf-8", errors="backslashreplace")
    except Hangs:
        return "refused", f"it took more than {SECONDS} s", b"hangs"
    except BaseException as error:
        return "refused", f"{type(error).__name__}: {str(error)[:300]}", type(error).__name__.encode()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _hang(*_: object) -> None:
    raise Hangs


def _peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
