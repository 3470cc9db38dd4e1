"""Calibrations that property tests draw."""

from hypothesis import strategies as st

from stereokit.calibration import Calibration


def cameras(**more):
    """Of any sensible pair; `more` are strategies for what else is drawn, or drawn otherwise."""
    principal = st.floats(1, 3000)
    parts = {"fx": st.floats(50, 5000), "baseline": st.floats(0.01, 2), "cx0": principal, "cx1": principal}
    return st.builds(Calibration, **{**parts, **more})
