import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data.synthetic.surfaces import Surface, Wave
from stereokit.errors import InputError

V = np.arange(0, 60, 7, dtype=np.float32)[:, None]
U = np.broadcast_to(np.arange(0, 160, 3, dtype=np.float32), (len(V), 54))

slopes = st.floats(-0.3, 0.3)
waves = st.builds(
    lambda steep, across, down, phase: Wave(steep / max(abs(across), 0.02), across, down, phase),
    st.floats(-0.12, 0.12),
    st.floats(-0.25, 0.25),
    st.floats(-0.25, 0.25),
    st.floats(0, 6.3),
)
surfaces = st.builds(
    Surface,
    centre=st.tuples(st.floats(0, 160), st.floats(0, 60)),
    disparity=st.floats(0, 90),
    slope=st.tuples(slopes, slopes),
    bend=st.tuples(st.floats(-0.002, 0.002), st.floats(-0.005, 0.005)),
    reach=st.floats(1, 40),
    waves=st.lists(waves, max_size=2).map(tuple),
)


@given(surface=surfaces)
@settings(deadline=None)
def test_the_right_view_finds_each_point_again(surface):
    match = U - surface.disparity_at(U, V)
    np.testing.assert_allclose(surface.left_columns(match, V), U, atol=2e-3)
    # no folds: what lies further right in one view does so in the other
    assert (np.diff(match, axis=1) > 0).all()


def test_a_plane_by_hand():
    plane = Surface(centre=(10.0, 20.0), disparity=5.0, slope=(0.25, -0.5))
    assert plane.is_plane
    assert plane.disparity_at(np.float32([[14]]), np.float32([[18]])).item() == 5 + 1 + 1
    assert plane.left_columns(np.float32([[7]]), np.float32([[18]])).item() == 14


def test_bends_by_hand():
    bowl = Surface(centre=(0.0, 0.0), disparity=5.0, bend=(0.01, 0.1), reach=10.0)
    columns = np.tile(np.float32([-10, 0, 5, 10, 12]), (2, 1))
    rows = np.float32([[0], [2]])
    expected = np.add([1, 0, 0.25, 1, 1 + 2 * 0.2], [[5], [5.4]])
    np.testing.assert_allclose(bowl.disparity_at(columns, rows), expected, rtol=1e-6)


@given(surface=surfaces, half_width=st.floats(1, 80), half_height=st.floats(1, 40))
@settings(deadline=None)
def test_span_bounds_the_disparity(surface, half_width, half_height):
    u0, v0 = surface.centre
    columns = np.linspace(u0 - half_width, u0 + half_width, 40, dtype=np.float32)
    rows = np.linspace(v0 - half_height, v0 + half_height, 20, dtype=np.float32)[:, None]
    disparity = surface.disparity_at(np.broadcast_to(columns, (20, 40)), rows)
    low, high = surface.span(half_width, half_height)
    assert low - 1e-3 <= disparity.min() <= disparity.max() <= high + 1e-3
    flat = Surface(surface.centre, surface.disparity, surface.slope)
    disparity = flat.disparity_at(np.broadcast_to(columns, (20, 40)), rows)
    assert flat.span(half_width, half_height) == pytest.approx((disparity.min(), disparity.max()), abs=1e-2)


@pytest.mark.parametrize(
    "parts",
    [{"slope": (0.9, 0.0)}, {"bend": (0.05, 0.0), "reach": 9.0}, {"waves": (Wave(4.0, 0.3, 0.0, 0.0),)}],
)
def test_a_surface_that_would_fold_is_refused(parts):
    with pytest.raises(InputError, match=r"px of disparity a column; expected at most 0\.8"):
        Surface((0.0, 0.0), 5.0, **parts)
