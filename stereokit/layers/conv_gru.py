"""A recurrent unit of convolutions."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

__all__ = ["ConvGRU"]


class ConvGRU(nn.Module):
    r"""A gated recurrent unit whose gates are 3x3 convolutions, with a context that is added to each.

    .. math:: z = \sigma(W_z [h, x] + c_z), \quad r = \sigma(W_r [h, x] + c_r), \quad
        q = \tanh(W_q [r h, x] + c_q), \quad h \leftarrow (1 - z) h + z q

    Args:
        hidden: channels of the state h.
        in_channels: of the input x.
        kernel_size: of the convolutions.

    Shape: state (B, hidden, h, w), context three (B, hidden, h, w) in the order z, r, q, inputs (B, ., h, w) with
    `in_channels` in all, to the state.

    Source: Teed and Deng, "RAFT", ECCV 2020, section 3.3; the context is that of "RAFT-Stereo", 3DV 2021.

    >>> state, context = torch.zeros(1, 4, 3, 5), torch.zeros(3, 1, 4, 3, 5)
    >>> ConvGRU(4, 6)(state, context, torch.rand(1, 2, 3, 5), torch.rand(1, 4, 3, 5)).shape
    torch.Size([1, 4, 3, 5])
    """

    def __init__(self, hidden: int, in_channels: int, *, kernel_size: int = 3) -> None:
        super().__init__()
        padding = kernel_size // 2
        self.update, self.reset, self.candidate = (
            nn.Conv2d(hidden + in_channels, hidden, kernel_size, padding=padding) for _ in range(3)
        )

    def forward(self, state: Tensor, context: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        """The state after one step."""
        for_update, for_reset, for_candidate = context
        both = torch.cat((state, *inputs), dim=1)
        update = torch.sigmoid(self.update(both) + for_update)
        reset = torch.sigmoid(self.reset(both) + for_reset)
        candidate = torch.tanh(self.candidate(torch.cat((reset * state, *inputs), dim=1)) + for_candidate)
        return (1 - update) * state + update * candidate
