import os
import subprocess
import sys

import pytest

from stereokit.runtime.memory.peak import PeakMemory

# in a process of its own: what other tests leave running or free takes no part
CODE = """
import torch
from stereokit.runtime.memory import PeakMemory, keep_freed_memory
{first}
torch.ones(64 * 2**18)
peak = PeakMemory("cpu")
held = torch.ones(32 * 2**18)
passing = torch.ones(96 * 2**18)
del passing
print(peak.bytes())
peak.restart()
print(peak.bytes())
"""


@pytest.mark.parametrize("first", ["", "keep_freed_memory()"])
def test_the_peak_is_that_of_what_was_taken_even_if_it_was_given_back(first: str) -> None:
    if PeakMemory("cpu").bytes() is None:
        pytest.skip("this system does not tell a process its peak memory")
    code, environment = CODE.format(first=first), {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    peak, after = (int(line) / 2**20 for line in done.stdout.split())
    # what was free before is not hidden
    assert 120 < peak < 180
    # what is held stays counted after a new beginning, what was given back does not
    assert 25 < after < 80


def test_other_devices_are_not_known() -> None:
    assert PeakMemory("meta").bytes() is None
