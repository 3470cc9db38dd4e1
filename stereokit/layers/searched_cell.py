"""The cell of LEAStereo and the path of cells through scales: what its architecture search chose between."""

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.errors import ConfigError
from stereokit.layers.convolution import ConvNormAct, relu

__all__ = ["CellNodes", "LevelPath", "SearchedCell", "level_size", "resize"]

CellNodes: TypeAlias = Sequence[Sequence[Sequence[str]]]
"""For each node of a cell its edges, each a source and an operation: "s0", "s1", or "n0", "n1", ... of a node before;
"conv" or "skip"."""

OUTPUTS = 4
"""The last inputs and nodes of a cell that it gives on."""


def level_size(size: Sequence[int], level: int) -> list[int]:
    """The size of a map after `level` halvings, odd ones rounded up.

    >>> level_size([12, 17], 2)
    [3, 5]
    """
    return [(side + 2**level - 1) // 2**level for side in size]


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    """Maps (B, C, H, W) or volumes (B, C, D, H, W) at another size, linearly; the middles of corner pixels stay.

    >>> resize(torch.tensor([[[[0.0, 2.0, 4.0]]]]), (1, 5)).flatten()
    tensor([0., 1., 2., 3., 4.])
    """
    return F.interpolate(x, size=list(size), mode="bilinear" if x.dim() == 4 else "trilinear", align_corners=True)


class SearchedCell(nn.Module):
    r"""A small graph of convolutions over the outputs of the two cells before.

    .. math::
        s_i = \mathrm{ReLU}(W_i x_i), \qquad n_j = \sum_{(k, o) \in E_j} o(k), \qquad
        y = [s_1, n_0, n_1, n_2]

    An operation o is a 3x3 (3x3x3) convolution with batch norm and ReLU, or the identity.

    Args:
        channels: of :math:`x_0`, the older output, and of :math:`x_1`.
        width: of each node; the output has four times that.
        nodes: the edges into each node, see `CellNodes`.
        dims: 2 for maps, 3 for volumes.

    Shape: two inputs of any size to (B, 4 * width, \*size).

    Raises:
        ConfigError: an edge from nowhere, another operation, or less than two nodes.

    Source: Cheng et al., "Hierarchical neural architecture search for deep stereo matching", NeurIPS 2020, section 3.1
    and figure 5.

    >>> nodes = [[("s0", "conv"), ("s1", "skip")], [("n0", "conv"), ("s1", "conv")], [("n1", "conv"), ("s0", "conv")]]
    >>> cell = SearchedCell((8, 8), 2, nodes, dims=2)
    >>> cell(torch.rand(1, 8, 4, 6), torch.rand(1, 8, 2, 3), (4, 6)).shape
    torch.Size([1, 8, 4, 6])
    """

    def __init__(self, channels: tuple[int, int], width: int, nodes: CellNodes, *, dims: Literal[2, 3]) -> None:
        super().__init__()
        self.edges = _checked(nodes)
        self.enter = nn.ModuleList(ConvNormAct(c, width, 1, dims=dims, activation=None) for c in channels)
        self.convs = nn.ModuleList(
            nn.ModuleList(
                ConvNormAct(width, width, dims=dims, activation=relu) if operation == "conv" else nn.Identity()
                for _, operation in edges
            )
            for edges in self.edges
        )

    def forward(self, before: Tensor, last: Tensor, size: Sequence[int]) -> Tensor:
        """The outputs of the two cells before, and the size of this one, to its output."""
        states = {f"s{i}": self._entered(i, x, size) for i, x in enumerate((before, last))}
        for j, edges in enumerate(self.edges):
            first, *others = (conv(states[source]) for (source, _), conv in zip(edges, self._convs(j), strict=True))
            states[f"n{j}"] = sum(others, start=first)
        return torch.cat(list(states.values())[-OUTPUTS:], dim=1)

    def _convs(self, node: int) -> nn.ModuleList:
        return cast(nn.ModuleList, self.convs[node])

    def _entered(self, number: int, x: Tensor, size: Sequence[int]) -> Tensor:
        enter, given = self.enter[number], tuple(x.shape[2:])
        if given == tuple(size):
            return F.relu(enter(x))
        # interpolation and 1x1 convolution commute: the one that leaves less to the other goes first. The statistics of
        # a norm in training do not
        if given[-1] < size[-1] and not self.training:
            return F.relu(resize(enter(x), size))
        return F.relu(enter(resize(x, size)))


class LevelPath(nn.Module):
    """Cells in a row, each at a level of its own: level l is the input halved l times, and 2^l times as wide.

    Args:
        levels: of the cells.
        nodes: of every cell, see `SearchedCell`.
        dims: 2 for maps, 3 for volumes.
        channels: of the two inputs.
        filters: width of a cell at level 0.
        skips: pairs of cells, an earlier and a later one of the same level: the cell behind the later one sees a
            3x3 convolution of both outputs in place of the later one's.

    Shape: two inputs of one size, at level 0, to (B, out_channels, ...) at the level of the last cell.

    Raises:
        ConfigError: no cells, a negative level, or a skip between cells of two levels.

    Source: Cheng et al., NeurIPS 2020, section 3.2 and figure 5.

    >>> path = LevelPath([1, 0], [[("s0", "conv")], [("s1", "skip"), ("n0", "conv")]], dims=3, channels=(6, 6),
    ...     filters=2)
    >>> x = torch.rand(1, 6, 4, 6, 8)
    >>> path.out_channels, path(x, x).shape
    (8, torch.Size([1, 8, 4, 6, 8]))
    """

    def __init__(
        self,
        levels: Sequence[int],
        nodes: CellNodes,
        *,
        dims: Literal[2, 3],
        channels: tuple[int, int],
        filters: int,
        skips: Sequence[Sequence[int]] = (),
    ) -> None:
        super().__init__()
        if not levels or min(levels) < 0:
            raise ConfigError(f"levels={list(levels)!r}: give one level from 0 up for each cell")
        for first, second in skips:
            if not 0 <= first < second < len(levels) - 1 or levels[first] != levels[second]:
                raise ConfigError(
                    f"skips={list(skips)!r}: each goes from a cell to a later one of its level, behind which there is "
                    f"another; the levels are {list(levels)}"
                )
        self.levels = list(levels)
        self.skips = {second: first for first, second in skips}
        widths = [filters * 2**level for level in levels]
        given = [*channels, *(OUTPUTS * width for width in widths)]
        self.cells = nn.ModuleList(
            SearchedCell((given[i], given[i + 1]), width, nodes, dims=dims) for i, width in enumerate(widths)
        )
        self.merge = nn.ModuleDict(
            {
                str(second): ConvNormAct(2 * given[second + 2], given[second + 2], dims=dims, activation=relu)
                for second in self.skips
            }
        )
        self.widths = given[2:]
        self.out_channels = given[-1]

    def forward(self, before: Tensor, last: Tensor, change: Callable[[int, Tensor], Tensor] | None = None) -> Tensor:
        """Both inputs to the output of the last cell; `change` is given the number and output of each."""
        size, outputs = last.shape[2:], []
        for number, (cell, level) in enumerate(zip(self.cells, self.levels, strict=True)):
            output = cell(before, last, level_size(size, level))
            outputs.append(output if change is None else change(number, output))
            before, last = last, self._merged(number, outputs)
        return last

    def _merged(self, number: int, outputs: Sequence[Tensor]) -> Tensor:
        """What a cell gives on: its output, or that merged with an earlier one."""
        if number not in self.skips:
            return outputs[number]
        return self.merge[str(number)](torch.cat((outputs[self.skips[number]], outputs[number]), dim=1))


def _checked(nodes: CellNodes) -> list[list[tuple[str, str]]]:
    edges = [[(source, operation) for source, operation in node] for node in nodes]
    if len(edges) < OUTPUTS - 2 or not all(edges):
        raise ConfigError(f"nodes={nodes!r}: a cell has {OUTPUTS - 2} nodes or more, each with one edge or more")
    for number, node in enumerate(edges):
        known = ["s0", "s1", *(f"n{i}" for i in range(number))]
        for source, operation in node:
            if source not in known or operation not in ("conv", "skip"):
                raise ConfigError(
                    f"node n{number} has an edge {source!r}, {operation!r}; sources are {', '.join(known)}, operations "
                    "'conv' and 'skip'"
                )
    return edges
