import ctypes
import sys

import pytest

from stereokit.backends.signal_stack import kept_signal_stack

SIZE = 1 << 16


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the layout of stack_t is that of Linux")
@pytest.mark.parametrize("raises", [False, True])
def test_another_stack_is_gone_behind_the_block(raises):
    library = ctypes.CDLL(None)
    before, after = ((ctypes.c_size_t * 3)() for _ in range(2))
    memory = ctypes.create_string_buffer(SIZE)
    # place, flags and size
    other = (ctypes.c_size_t * 3)(ctypes.addressof(memory), 0, SIZE)
    library.sigaltstack(None, before)
    try:
        with kept_signal_stack():
            assert library.sigaltstack(other, None) == 0
            library.sigaltstack(None, after)
            assert list(after) == list(other)
            if raises:
                raise KeyError
    except KeyError:
        pass
    library.sigaltstack(None, after)
    assert list(after) == list(before)
