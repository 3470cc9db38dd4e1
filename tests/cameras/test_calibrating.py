import json
from dataclasses import replace

import numpy as np
import pytest

from stereokit.cameras.boards import CharucoBoard, Checkerboard
from stereokit.cameras.calibrating import calibrate_rig
from stereokit.cameras.calibration_quality import epipolar_rms
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import RigRenderer, example_rig
from stereokit.cameras.rig import read_rig
from stereokit.cameras.views import BoardView
from stereokit.errors import InputError
from tests.cameras.rendered_rig import SIZE, exact_views, rendered_views, volume

BOARD = Checkerboard(9, 6, 0.025)


def views(of, count=45, noise=0.04, **where):
    return exact_views(of, BOARD, count, noise, **where)


def test_a_pinhole_rig_is_found(tmp_path):
    true = example_rig()
    found = calibrate_rig(views(true), SIZE)
    assert found.rejected == {}
    assert found.quality.rms < 0.1
    assert found.quality.held_out_rms < 1.5 * found.quality.epipolar_rms
    assert found.rig.baseline == pytest.approx(true.baseline, rel=1e-3)
    for side in ("left", "right"):
        assert getattr(found.rig, side).fx == pytest.approx(getattr(true, side).fx, rel=1e-3)
    # rows and depth at places where no board was
    points = volume(true)
    rectification = rectify(found.rig)
    assert epipolar_rms(rectification, found.rig, [points]) < 0.05
    assert {view.name for view in found.views} == {view.name for view in views(true)}
    assert all(0 < view.left < 0.2 and 0 < view.right < 0.2 and 0.3 < view.distance < 1.1 for view in found.views)
    found.rig.write(tmp_path / "rig.json", about=found.to_dict())
    assert read_rig(tmp_path / "rig.json") == found.rig
    assert json.loads((tmp_path / "rig.json").read_text())["about"]["quality"]["views"] == found.quality.views


@pytest.mark.slow
def test_poor_views_are_found_exactly():
    good = views(example_rig())
    bad = [
        replace(view, right=view.right + np.array([0.0, 3.0])) if i in (4, 17) else view for i, view in enumerate(good)
    ]
    found = calibrate_rig(bad, SIZE)
    assert sorted(found.rejected) == sorted([good[4].name, good[17].name])
    without = calibrate_rig([view for i, view in enumerate(good) if i not in (4, 17)], SIZE)
    # as if they had never been there
    for side in ("left", "right"):
        np.testing.assert_allclose(getattr(found.rig, side).matrix, getattr(without.rig, side).matrix, atol=1e-4)
    np.testing.assert_allclose(found.rig.translation, without.rig.translation, atol=1e-7)
    few = calibrate_rig(bad, SIZE, least_views=len(bad) - 1)
    assert len(few.rejected) == 1


def test_a_fisheye_rig_is_found():
    true = example_rig("fisheye")
    found = calibrate_rig(views(true, count=60, near=0.2, far=0.5, wide=1.3), SIZE, model="fisheye")
    assert found.rig.left.model == "fisheye"
    assert found.quality.rms < 0.1
    assert found.rig.baseline == pytest.approx(true.baseline, rel=2e-3)
    assert found.rig.left.fx == pytest.approx(true.left.fx, rel=2e-3)
    assert epipolar_rms(rectify(found.rig), found.rig, [volume(true)]) < 0.15


def test_fisheye_views_may_show_different_parts():
    """A camera of 140 degrees, of whose views most show a part of the board."""
    true = example_rig("fisheye", field_of_view=140)
    rng = np.random.default_rng(0)
    parts = []
    for view in exact_views(true, BOARD, 60, near=0.1, far=0.4, wide=2.0):
        shown = np.sort(rng.choice(len(view.left), rng.integers(12, len(view.left)), replace=False))
        parts.append(
            replace(view, object_points=view.object_points[shown], left=view.left[shown], right=view.right[shown])
        )
    assert len(parts) > 20
    found = calibrate_rig(parts, SIZE, model="fisheye")
    assert found.quality.rms < 0.1
    assert found.rig.baseline == pytest.approx(true.baseline, rel=2e-3)
    for side in ("left", "right"):
        assert getattr(found.rig, side).fx == pytest.approx(getattr(true, side).fx, rel=2e-3)
    assert epipolar_rms(rectify(found.rig), found.rig, [volume(true)]) < 0.15


def test_fisheye_cameras_that_make_no_sense_are_refused():
    true = example_rig("fisheye")
    rng = np.random.default_rng(0)
    wild = [replace(view, left=view.left + rng.normal(0, 20, view.left.shape)) for view in views(true, count=20)]
    with pytest.raises(InputError, match=r"fisheye model .* (makes no sense|can't be solved)"):
        calibrate_rig(wild, SIZE, model="fisheye")


@pytest.mark.slow
def test_what_is_no_rig_is_refused():
    good = views(example_rig())
    swapped = [replace(view, left=view.right, right=view.left) for view in good]
    with pytest.raises(InputError, match="the views are swapped"):
        calibrate_rig(swapped, SIZE)
    with pytest.raises(InputError, match="7 views of the board; expected at least 8"):
        calibrate_rig(good[:7], SIZE)
    with pytest.raises(InputError, match="4, 5 or 8 coefficients, got 3"):
        calibrate_rig(good, SIZE, coefficients=3)
    with pytest.raises(InputError, match="fisheye cameras have 4 coefficients, got 5"):
        calibrate_rig(good, SIZE, model="fisheye", coefficients=5)
    with pytest.raises(InputError, match="at least 5 views must be kept, got least_views=3"):
        calibrate_rig(good, SIZE, least_views=3)
    huge = [replace(view, object_points=view.object_points * 100) for view in good]
    with pytest.raises(InputError, match="expected 5 mm to 5 m; check the unit"):
        calibrate_rig(huge, SIZE)
    with pytest.raises(InputError, match=r"^calibrate: .* can't be solved for|^rectify: |^rig: "):
        calibrate_rig([good[0]] * 10, SIZE)


@pytest.mark.slow
def test_warnings_say_what_to_do():
    true = example_rig()
    flat = calibrate_rig(views(true, near=0.6, far=0.7, tilt=3.0, wide=0.2), SIZE).warnings
    for words in ("of the left image", "tilted by", "show it at distances that differ"):
        assert any(words in warning for warning in flat), flat
    noisy = calibrate_rig(views(true, noise=0.8), SIZE).warnings
    assert any("expected 0.5 or less" in warning for warning in noisy), noisy
    all_over = calibrate_rig(views(true, count=120, near=0.3, far=0.9, wide=0.95), SIZE)
    assert not any("tilted" in warning or "distances" in warning for warning in all_over.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("board", "model", "rms", "most"),
    [
        (BOARD, "pinhole", 0.1, 0.06),
        (CharucoBoard(9, 6, 0.03, 0.023), "pinhole", 0.1, 0.1),
        (BOARD, "fisheye", 0.1, 0.15),
        # corners beside markers that are seen aslant are found less well
        (CharucoBoard(9, 6, 0.03, 0.023), "fisheye", 0.2, 0.15),
    ],
    ids=["checkerboard", "charuco", "fisheye", "fisheye charuco"],
)
def test_a_rendered_rig_from_pictures_to_depth(board, model, rms, most):
    true = example_rig(model)
    where = {"near": 0.15, "far": 0.4, "wide": 1.4} if model == "fisheye" else {"near": 0.3, "far": 0.8}
    found = rendered_views(RigRenderer(true), board, 36, **where)
    usable = [view for view in found if isinstance(view, BoardView)]
    assert len(usable) >= 15
    result = calibrate_rig(usable, SIZE, model=model)
    assert result.quality.rms < rms
    assert result.rig.baseline == pytest.approx(true.baseline, rel=1e-3)
    assert result.rig.left.fx == pytest.approx(true.left.fx, rel=1e-3)
    points = volume(true)
    assert epipolar_rms(rectify(result.rig), result.rig, [points]) < most
