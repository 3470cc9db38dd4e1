"""Where in its bin a disparity lies."""

from torch import Tensor

__all__ = ["bin_shift"]


def bin_shift(x: Tensor) -> Tensor:
    r"""Any numbers to parts of a bin, both of whose ends are reached.

    .. math:: b(x) = \tfrac12 + \tfrac12 \max(-1, \min(1, \tfrac32 \tanh x))

    Args:
        x: of any shape.

    Returns:
        Of the same shape, from 0 to 1.

    Source: Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020, with the constants of
    the authors' code.

    >>> import torch
    >>> bin_shift(torch.tensor([-9.0, 0.0, 9.0]))
    tensor([0.0000, 0.5000, 1.0000])
    """
    return 0.5 + 0.5 * (1.5 * x.tanh()).clamp(-1, 1)
