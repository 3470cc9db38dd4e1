import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError
from stereokit.layers import LevelPath, SearchedCell, level_size, resize

NODES = [
    [("s0", "conv"), ("s1", "skip")],
    [("s1", "conv"), ("n0", "conv")],
    [("s0", "conv"), ("n1", "conv")],
]
SOURCES = st.integers(2, 4).flatmap(
    lambda count: st.tuples(
        *(
            st.lists(
                st.tuples(
                    st.sampled_from(["s0", "s1", *(f"n{i}" for i in range(number))]), st.sampled_from(["conv", "skip"])
                ),
                min_size=1,
                max_size=3,
            )
            for number in range(count)
        )
    )
)
DIMS = st.sampled_from([2, 3])


@given(SOURCES, DIMS, st.integers(0, 9))
def test_a_cell_is_the_graph_that_its_nodes_say(nodes, dims, seed):
    torch.manual_seed(seed)
    cell = SearchedCell((3, 5), 2, nodes, dims=dims).eval()
    size = (4, 6, 5)[:dims]
    before, last = torch.randn(1, 3, *size), torch.randn(1, 5, *size)
    known = {"s0": cell.enter[0](before).relu(), "s1": cell.enter[1](last).relu()}
    for j, node in enumerate(nodes):
        parts = [
            known[source] if op == "skip" else cell.convs[j][i](known[source]) for i, (source, op) in enumerate(node)
        ]
        known[f"n{j}"] = torch.stack(parts).sum(0)
    assert_close(cell(before, last, size), torch.cat([*known.values()][-4:], dim=1))


@given(DIMS, st.booleans(), st.integers(1, 5), st.integers(1, 5), st.integers(0, 9))
def test_an_input_is_resized_ahead_of_its_convolution(dims, training, given_size, wanted, seed):
    torch.manual_seed(seed)
    # in training the order matters to the norm, which here leaves all as it is
    cell = SearchedCell((3, 3), 2, NODES, dims=dims).train(training).double()
    for enter in cell.enter:
        enter[1] = nn.Identity()
    cell.convs.eval()
    x = torch.randn(1, 3, *[given_size] * dims, dtype=torch.float64)
    size = [wanted + i for i in range(dims)]
    resized = resize(x, size)
    assert_close(cell(x, x, size), cell(resized, resized, size))


def test_norms_see_the_size_of_the_cell_in_training():
    cell = SearchedCell((2, 2), 2, NODES, dims=2).train()
    seen = []
    cell.enter[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].shape[-2:]))
    x = torch.randn(2, 2, 3, 3)
    cell(x, x, (6, 6))
    cell.eval()(x, x, (6, 6))
    assert seen == [(6, 6), (3, 3)]


@given(st.integers(1, 40), st.integers(0, 3))
def test_a_level_is_what_halving_again_and_again_gives(side, level):
    halved = side
    for _ in range(level):
        halved = (halved + 1) // 2
    assert level_size([side], level) == [halved]


@given(st.integers(2, 6), st.integers(2, 6))
def test_resizing_keeps_corners_and_straight_lines(given_size, wanted):
    line = torch.linspace(0, 1, given_size, dtype=torch.float64)
    x = (line[:, None] + 2 * line).expand(1, 1, -1, -1)
    again = torch.linspace(0, 1, wanted, dtype=torch.float64)
    assert_close(resize(x, (wanted, wanted))[0, 0], again[:, None] + 2 * again)


def test_cells_see_the_two_before_them_at_their_own_level():
    levels = [1, 2, 0]
    path = LevelPath(levels, NODES, dims=2, channels=(3, 5), filters=2).eval()
    before, last = torch.randn(1, 3, 8, 12), torch.randn(1, 5, 8, 12)
    x, y = before, last
    for cell, level in zip(path.cells, levels, strict=True):
        size = (8 // 2**level, 12 // 2**level)
        x, y = (
            y,
            cell(F.interpolate(x, size, mode="bilinear", align_corners=True) if x.shape[2:] != size else x, y, size),
        )
    assert_close(path(before, last), y)
    assert path.out_channels == 8


def test_a_skip_replaces_what_both_next_cells_see():
    path = LevelPath([0, 0, 0, 0], NODES, dims=3, channels=(4, 4), filters=1, skips=[(0, 1)]).eval()
    x = torch.randn(1, 4, 3, 4, 5)
    size = x.shape[2:]
    first = path.cells[0](x, x, size)
    second = path.cells[1](x, first, size)
    merged = path.merge["1"](torch.cat((first, second), dim=1))
    third = path.cells[2](first, merged, size)
    assert_close(path(x, x), path.cells[3](merged, third, size))


def test_two_skips_join_the_outputs_themselves():
    """The second one takes the later cell's output, not what the first skip made of it."""
    path = LevelPath([0, 0, 0, 0], NODES, dims=2, channels=(4, 4), filters=1, skips=[(0, 1), (1, 2)]).eval()
    outputs, joined = [], []
    for cell in path.cells:
        cell.register_forward_hook(lambda _module, _inputs, output: outputs.append(output))
    path.merge["2"].register_forward_pre_hook(lambda _, inputs: joined.append(inputs[0]))
    path(torch.randn(1, 4, 4, 6), torch.randn(1, 4, 4, 6))
    assert_close(joined[0], torch.cat((outputs[1], outputs[2]), dim=1))


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([[("s0", "conv")]], "2 nodes or more"),
        ([[("s0", "conv")], []], "one edge or more"),
        ([[("n0", "conv")], [("s0", "conv")]], "node n0 has an edge 'n0'"),
        ([[("s0", "pool")], [("s0", "conv")]], "operations 'conv' and 'skip'"),
    ],
)
def test_cells_that_are_none_are_refused(nodes, message):
    with pytest.raises(ConfigError, match=message):
        SearchedCell((4, 4), 2, nodes, dims=2)


@pytest.mark.parametrize(
    ("levels", "skips", "message"),
    [
        ([], [], "one level"),
        ([0, -1], [], "one level"),
        ([0, 1, 0], [(0, 1)], "later one of its level"),
        ([0, 0], [(0, 1)], "behind which there is another"),
    ],
)
def test_paths_that_are_none_are_refused(levels, skips, message):
    with pytest.raises(ConfigError, match=message):
        LevelPath(levels, NODES, dims=2, channels=(4, 4), filters=1, skips=skips)
