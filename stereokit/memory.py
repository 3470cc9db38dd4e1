"""How much memory a pass through a network takes, and how much there is."""

import copy
import ctypes
import os
import re
import sys
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from stereokit.errors import ConfigError, InputError

__all__ = [
    "MemorySize",
    "available_memory",
    "estimate_memory",
    "format_memory",
    "hand_back_memory",
    "parse_memory",
    "running_out_as",
]

MemorySize: TypeAlias = int | str
"""Bytes, or a text such as "4GiB", "500 MB" or "1.5G"."""

UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
"""Powers of 1000 (GB) and of 1024 (GiB)."""

HELD_BY_ALLOCATOR = 1.2
"""Allocators hold more than what is in use: gaps, and blocks that they keep for later."""


def estimate_memory(
    model: nn.Module, height: int, width: int, *, batch: int = 1, dtype: torch.dtype = torch.uint8
) -> int:
    """The peak memory of one pass through a network in bytes, beside its weights; nothing is computed.

    Counted are the images and every tensor that the pass makes, for as long as it lives; what convolutions of the CPU
    take beside them, which is their input as columns where they are done as a plain matrix product, and else copies in
    the layout of oneDNN; and a fifth on top for what allocators hold. For CoEx, PSMNet and GC-Net in float32 on a CPU
    the peak that was measured was 0.8 to 1.1 times that at 384 x 1248 pixels and alike, up to 1.5 times at a quarter of
    that. What cuDNN takes for its own use is not known and not counted.

    Args:
        model: any module ``(left, right) -> StereoOutput``, in eval mode, on its device.
        height: of the images.
        width: of the images.
        batch: pairs at once.
        dtype: of the images.

    Raises:
        ConfigError: the network does something that can't be followed without computing it.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=64).eval()
    >>> small, large = (estimate_memory(model, 256, width) for width in (256, 512))
    >>> 1.8 < large / small < 2.2
    True
    """
    # slow to import, and few need it
    from torch._subclasses.fake_tensor import FakeTensorMode

    # tensors that know their shape, type and device, and hold no data
    fake = FakeTensorMode(allow_non_fake_inputs=True)
    weights = [*model.parameters(), *model.buffers()]
    where = weights[0].device if weights else torch.device("cpu")
    try:
        # a copy, for other threads may be running the network
        twin = copy.deepcopy(model, {id(tensor): fake.from_tensor(tensor) for tensor in weights})
        # convolutions are counted as one operation, which inference mode would show in other ones
        with torch.inference_mode(False), fake, torch.no_grad(), _LiveBytes() as memory:
            left, right = (torch.empty(batch, 3, height, width, dtype=dtype, device=where) for _ in range(2))
            twin(left, right)
    except Exception as error:
        # anything may go wrong in anybody's network
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ConfigError(
            f"the memory that {type(model).__name__} needs can't be found out without running it: {reason}"
        ) from error
    return int(memory.peak * HELD_BY_ALLOCATOR)


class _LiveBytes(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the bytes of all tensors that were made in its block and are still alive."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.live = 0
        self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if isinstance(tensor, Tensor):
                self._add(tensor.untyped_storage())
        workspace = 0
        if func is torch.ops.aten.convolution.default and result.device.type == "cpu":
            workspace = _convolution_workspace(result, *args)
        self.peak = max(self.peak, self.live + workspace)
        return result

    def _add(self, storage: torch.UntypedStorage) -> None:
        # a view has the storage of what it looks at
        key = storage._cdata
        if key not in self._known:
            self._known.add(key)
            self.live += storage.nbytes()
            weakref.finalize(storage, self._drop, key, storage.nbytes())

    def _drop(self, key: int, nbytes: int) -> None:
        self._known.discard(key)
        self.live -= nbytes


def _convolution_workspace(result: Tensor, x: Tensor, weight: Tensor, *settings: Any) -> int:
    """Bytes that a convolution of the CPU needs beside its input and its output."""
    bias, stride, padding, dilation, transposed, output_padding, groups = settings
    backend = torch._C._select_conv_backend(
        x, weight, bias, stride, padding, dilation, transposed, output_padding, groups
    )
    if "Slow" in backend.name:
        # one image at a time: a column of the kernel's size for each place of the output, or of the input if transposed
        places = (x if transposed else result)[0, 0].numel()
        return places * weight[0].numel() * x.element_size()
    channels_last = torch.channels_last_3d if x.dim() == 5 else torch.channels_last
    if x.is_contiguous(memory_format=channels_last):
        return 0
    return x.numel() * x.element_size() + result.numel() * result.element_size()


def available_memory(device: str | torch.device = "cpu") -> int | None:
    """The free memory of a device in bytes; None where the system does not tell.

    Of a GPU what the driver calls free and what torch holds unused. Of the CPU what Linux calls available, within the
    limit of the container; on other systems all the memory that is built in. What this process keeps of freed tensors
    counts as taken, see `hand_back_memory`.

    >>> available = available_memory("cpu")
    >>> available is None or available > 0
    True
    """
    device = torch.device(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        # a runtime of exported files may use what torch was not built for
        return None
    if device.type == "cuda":
        held_unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + held_unused
    limits = [limit for limit in (_linux_available(), _container_available()) if limit is not None]
    if limits:
        return min(limits)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _linux_available(path: Path = Path("/proc/meminfo")) -> int | None:
    try:
        found = re.search(r"^MemAvailable:\s+(\d+) kB", path.read_text(), re.MULTILINE)
    except OSError:
        return None
    return int(found[1]) * 1024 if found else None


def _container_available(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    """What a limit of control groups, version 2, leaves."""
    try:
        limit, used, parts = ((folder / f"memory.{name}").read_text().strip() for name in ("max", "current", "stat"))
    except OSError:
        return None
    if limit == "max":
        return None
    # pages of files that the kernel drops when memory is asked for
    droppable = re.search(r"^inactive_file (\d+)$", parts, re.MULTILINE)
    return max(0, int(limit) - int(used) + (int(droppable[1]) if droppable else 0))


def hand_back_memory() -> None:
    """Gives the system back what the C library keeps of freed tensors, see `stereokit.optimize.keep_freed_memory`.

    Does nothing but on Linux with the GNU C library.

    Source: malloc_trim(3).

    >>> hand_back_memory()
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


@contextmanager
def running_out_as(message: str) -> Iterator[None]:
    """Turns an allocation that fails in its block, on any device, into an `InputError`.

    >>> with running_out_as("too large"):
    ...     torch.empty(2**55)
    Traceback (most recent call last):
    stereokit.errors.InputError: too large
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # a failure of the CPU's allocator has no class of its own
        if isinstance(error, torch.OutOfMemoryError | MemoryError) or "can't allocate memory" in str(error):
            raise InputError(message) from error
        raise


def parse_memory(size: MemorySize) -> int:
    """An amount of memory in bytes.

    Raises:
        ConfigError: not a positive amount.

    >>> parse_memory("4GiB") == 4 * 2**30, parse_memory("500 MB"), parse_memory(1024)
    (True, 500000000, 1024)
    """
    if isinstance(size, str):
        found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?I?)B?", size.strip().upper())
        nbytes = int(float(found[1]) * UNITS[found[2]]) if found and found[2] in UNITS else 0
    else:
        nbytes = 0 if isinstance(size, bool) or not isinstance(size, int) else size
    if nbytes <= 0:
        raise ConfigError(f"{size!r} is no amount of memory; bytes, or a text such as '4GiB' or '500MB' would do")
    return nbytes


def format_memory(nbytes: float) -> str:
    """Bytes for people to read.

    >>> format_memory(3 * 2**29), format_memory(5 * 2**20)
    ('1.5 GiB', '5 MiB')
    """
    return f"{nbytes / 2**30:.1f} GiB" if nbytes >= 2**30 else f"{nbytes / 2**20:.0f} MiB"
