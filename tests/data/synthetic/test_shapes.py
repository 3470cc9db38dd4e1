import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data.synthetic.shapes import Blob, Box, Ellipse, Lattice, Polygon, Wire

DV = np.arange(-89.75, 90, 0.5, dtype=np.float32)[:, None]
DU = np.broadcast_to(np.arange(-89.75, 90, 0.5, dtype=np.float32), (len(DV), 360))

sizes, angles = st.floats(3, 50), st.floats(-4, 4)
shapes = st.one_of(
    st.builds(Box, sizes, sizes, angles),
    st.builds(Ellipse, sizes, sizes, angles),
    st.builds(Ellipse, sizes, sizes, angles, st.floats(0.2, 0.8)),
    st.builds(lambda turn, a, b: Polygon(tuple(turn + k * 1.5 for k in range(4)), (a, b, a, b)), angles, sizes, sizes),
    st.builds(lambda r, k, a: Blob(r, ((k, a, 1.0),)), sizes, st.integers(2, 7), st.floats(0, 0.2)),
    st.builds(Wire, sizes, st.floats(1, 4), st.floats(0, 10), st.floats(0.01, 0.2), angles),
    st.builds(Lattice, sizes, sizes, st.floats(8, 30), st.floats(1, 6), st.booleans(), angles),
)


@given(shape=shapes)
@settings(deadline=None)
def test_nothing_lies_beyond_the_extent(shape):
    rows, columns = np.nonzero(shape.distance(DU, DV) < 0)
    half_width, half_height = shape.extent
    assert np.abs(DU[0, columns]).max(initial=0) <= half_width + 1e-3
    assert np.abs(DV[rows, 0]).max(initial=0) <= half_height + 1e-3


@given(shape=shapes)
@settings(deadline=None)
def test_the_distance_is_one_near_the_outline(shape):
    distance = shape.distance(DU, DV)
    assert distance.dtype == np.float32
    near = np.abs(distance[1:, 1:]) < 0.4
    steps = np.hypot(np.diff(distance, axis=0)[:, 1:], np.diff(distance, axis=1)[1:]) / 0.5
    if near.sum() > 50:
        assert 0.6 < np.median(steps[near]) < 1.5


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (Box(20, 10, 0.7), 800),
        (Ellipse(30, 10, 0.7), math.pi * 300),
        (Ellipse(30, 20, 0.0, hole=0.5), math.pi * 600 * 0.75),
        (Polygon((0.0, math.pi / 2, math.pi, 1.5 * math.pi), (10.0, 20.0, 30.0, 40.0)), 40 * 60),
        (Blob(20, ((3, 0.2, 0.0),)), math.pi * 400 * 1.02),
        (Wire(40, 2, 0, 0.1, 0.5), 80 * 4),
        (Lattice(35, 20, 10, 2), 7 * 2 * 40),
        (Lattice(35, 25, 10, 2, crossed=True), 7 * 2 * 50 + 5 * 2 * 70 - 35 * 4),
    ],
)
def test_areas(shape, area):
    assert (shape.distance(DU, DV) < 0).sum() / 4 == pytest.approx(area, rel=0.04)
