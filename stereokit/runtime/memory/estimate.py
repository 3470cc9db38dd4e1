"""How much memory a pass through a network takes."""

import copy
import logging
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from stereokit.errors import ConfigError

__all__ = ["estimate_memory"]

HELD_BY_ALLOCATOR = 1.2
"""Allocators hold more than what is in use: gaps, and blocks that they keep for later."""


def estimate_memory(
    model: nn.Module, height: int, width: int, *, batch: int = 1, dtype: torch.dtype = torch.uint8
) -> int:
    """The peak memory of one pass through a network in bytes, beside its weights; nothing is computed.

    Counted are the images and every tensor that the pass makes, for as long as it lives; what convolutions of the CPU
    take beside them, which is their input as columns where they are done as a plain matrix product, and else copies in
    the layout of oneDNN, of their weights too; and a fifth on top for what allocators hold. For CoEx, PSMNet and GC-Net
    in float32 on a CPU the peak that was measured was 0.8 to 1.1 times that at 384 x 1248 pixels and alike, up to 1.5
    times at a quarter of that. What cuDNN takes for its own use is not known and not counted.

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
        with _quiet(), torch.inference_mode(False), fake, torch.no_grad(), _LiveBytes() as memory:
            left, right = (torch.empty(batch, 3, height, width, dtype=dtype, device=where) for _ in range(2))
            twin(left, right)
    except Exception as error:
        # anything may go wrong in anybody's network
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ConfigError(
            f"the memory that {type(model).__name__} needs can't be found out without running it: {reason}"
        ) from error
    return int(memory.peak * HELD_BY_ALLOCATOR)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the traceback that PyTorch prints of an operation that fails, whose error says it too."""
    log = logging.getLogger("torch._subclasses.fake_tensor")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


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
    copied = [weight] if x.is_contiguous(memory_format=channels_last) else [weight, x, result]
    return sum(tensor.numel() * tensor.element_size() for tensor in copied)
