import pytest
import torch

from stereokit.runtime.memory.peak import PeakMemory

MEBIBYTE = 2**20


@pytest.fixture
def peak() -> PeakMemory:
    peak = PeakMemory("cpu")
    if peak.bytes() is None:
        pytest.skip("this system does not tell a process its peak memory")
    return peak


def test_the_peak_is_that_of_what_was_taken_even_if_it_was_given_back(peak: PeakMemory) -> None:
    held = torch.ones(32 * MEBIBYTE // 4)
    passing = torch.ones(96 * MEBIBYTE // 4)
    del passing
    assert 120 * MEBIBYTE < peak.bytes() < 180 * MEBIBYTE
    # what is held stays counted after a new beginning, what was given back does not
    peak.restart()
    assert 25 * MEBIBYTE < peak.bytes() < 80 * MEBIBYTE
    assert held.sum() > 0


def test_memory_that_was_free_before_is_not_hidden() -> None:
    torch.ones(64 * MEBIBYTE // 4)
    peak = PeakMemory("cpu")
    if peak.bytes() is None:
        pytest.skip("this system does not tell a process its peak memory")
    torch.ones(64 * MEBIBYTE // 4)
    assert peak.bytes() > 55 * MEBIBYTE


def test_other_devices_are_not_known() -> None:
    assert PeakMemory("meta").bytes() is None
