import subprocess
import sys

import pytest

CODE = """
import resource, torch
from stereokit.optimize import keep_freed_memory
torch.set_num_threads(1)
{}
def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(48 * 2**18)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
for _ in range(4):
    pages()
print(sum(pages() for _ in range(5)))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="settings of the GNU C library")
@pytest.mark.slow
def test_freed_memory_is_used_again():
    def faults(line):
        result = subprocess.run([sys.executable, "-c", CODE.format(line)], capture_output=True, text=True, check=True)
        return int(result.stdout)

    kept, returned = faults("assert keep_freed_memory()"), faults("")
    assert kept < returned / 4
