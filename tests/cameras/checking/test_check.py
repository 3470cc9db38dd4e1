import json
import re
from functools import cache

import cv2
import numpy as np
import pytest

from stereokit.cameras import Calibration
from stereokit.cameras.checking import check_pair, matches_picture
from stereokit.cameras.checking.thresholds import THRESHOLDS
from stereokit.data import read_image
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import InputError
from tests.shared import SHARED, needs_shared

SCENES = SyntheticScenes(seed=11, size=(240, 320), max_disparity=40, photometric=0, plain=0)
GOOD = (1, 4, 6)
HEIGHT, WIDTH = 240, 320


@cache
def pair(index):
    sample = SCENES[index]
    return sample.left, sample.right


def affine(image, matrix):
    return cv2.warpAffine(image, np.array(matrix, np.float64), image.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=1)


def turned(image, degrees, factor=1.0):
    centre = (image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2
    # OpenCV's angle is counter-clockwise
    return affine(image, cv2.getRotationMatrix2D(centre, -degrees, factor))


def shifted(image, down):
    return affine(image, [[1, 0, 0], [0, 1, down]])


def names(check):
    return [finding.name for finding in check.findings]


@pytest.mark.parametrize("index", GOOD)
def test_nothing_is_wrong_with_a_good_pair(index):
    left, right = pair(index)
    truth = SCENES[index].disparity
    camera = Calibration(300.0, 0.1, 160.0, 160.0, WIDTH, HEIGHT)
    check = check_pair(left, right, camera, max_disparity=64)
    assert check.severity == "good", str(check)
    assert check.findings == ()
    assert str(check) == "good: nothing is wrong with this pair"
    assert abs(check.measured["vertical_shift"]) < 0.1
    low, high = np.percentile(truth, [0, 100])
    assert low - 1 < check.measured["disparity_low"] < check.measured["disparity_high"] < high + 1


def test_the_same_pair_gives_the_same_result():
    left, right = pair(1)
    assert check_pair(left, right).to_dict() == check_pair(left.copy(), right.copy()).to_dict()


@pytest.mark.parametrize("index", GOOD)
@pytest.mark.parametrize(
    ("disturb", "name", "severity", "message"),
    [
        (lambda left, right: (right, left), "swapped", "unusable", "the views are swapped"),
        (lambda left, right: (left[:, ::-1], right[:, ::-1]), "swapped", "unusable", "both are mirrored"),
        (lambda left, right: (left[::-1, ::-1], right[::-1, ::-1]), "swapped", "unusable", "turned by 180 degrees"),
        (lambda left, right: (left, right[:, ::-1]), "mirrored", "unusable", "one view is mirrored"),
        (lambda left, right: (left, right[::-1, ::-1]), "turned", "unusable", "one view is turned by 180 degrees"),
        (lambda left, right: (left, left), "same_image", "unusable", "the same image"),
        (lambda left, right: (left, shifted(right, 1.5)), "vertical_shift", "warning", r"lies 1\.5 px lower"),
        (lambda left, right: (left, shifted(right, -4)), "vertical_shift", "unusable", r"lies (3\.9|4\.0) px higher"),
        (lambda left, right: (left, turned(right, 2)), "roll", "unusable", r"turned by (1\.9|2\.0)"),
        (lambda left, right: (left, turned(right, -0.45)), "roll", "warning", r"turned by -0\.[45]"),
        (lambda left, right: (left, turned(right, 0, 1.04)), "zoom", "unusable", r"is 1\.0(39|4)"),
        (lambda left, right: (left, np.zeros_like(right)), "textureless", "unusable", "the right view has next to no"),
        (
            lambda left, right: (left // 64 * 0 + 90, right * 0 + 90),
            "textureless",
            "unusable",
            "left and the right view",
        ),
        (lambda left, right: (left, pair(9)[1]), "unrelated", "unusable", "different scenes or moments"),
        (lambda left, right: (left, right[:-1]), "size", "unusable", "320 x 240 pixels, the right one 320 x 239"),
        (lambda left, right: (left, (right * 0.4).astype(np.uint8)), "exposure", "warning", r"0\.40 times as bright"),
        (
            lambda left, right: (left, cv2.GaussianBlur(right, (0, 0), 1.2)),
            "blur",
            "warning",
            r"the right view has 0\.0",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_disturbance_is_named(index, disturb, name, severity, message):
    check = check_pair(*disturb(*pair(index)))
    found = {finding.name: finding for finding in check.findings}
    assert name in found, str(check)
    assert found[name].severity == severity, str(check)
    assert re.search(message, found[name].message), str(check)
    assert ": " in found[name].message  # what to do
    assert check.severity == severity
    assert json.loads(json.dumps(check.to_dict()))["severity"] == severity


@pytest.mark.parametrize("index", GOOD)
def test_a_vertical_rig(index):
    left, right = (np.ascontiguousarray(view.transpose(1, 0, 2)) for view in pair(index))
    check = check_pair(left, right)
    assert names(check)[0] == "vertical_rig", str(check)
    # points of the left view lie lower by the disparity, so its camera stands higher
    assert "the left view's above" in check.findings[0].message


# of the other scene so few points lie apart that its views, swapped, look shifted as a whole
@pytest.mark.parametrize("index", [index for index in GOOD if index != 4])
def test_a_vertical_rig_with_its_views_swapped(index):
    left, right = (np.ascontiguousarray(view.transpose(1, 0, 2)) for view in pair(index))
    assert "the right view's above" in check_pair(right, left).findings[0].message


@pytest.mark.parametrize("index", GOOD)
def test_toed_in_cameras_and_what_mends_them(index):
    left, right = pair(index)
    low = check_pair(left, right).measured["disparity_low"]
    cut = int(low) + 6  # columns that one view lacks
    left, right = left[:, cut:], right[:, :-cut]
    camera = Calibration(300.0, 0.1, 150.0, 160.0, WIDTH - cut, HEIGHT)
    check = check_pair(left, right, camera)
    found = {finding.name: finding for finding in check.findings}
    assert "toed_in" in found or "swapped" in found, str(check)
    if "toed_in" in found:
        shift = int(found["toed_in"].message.split("cut ")[1].split()[0])
        width = WIDTH - cut - shift
        mended = camera.cropped(top=0, left=0, left_of_right=shift, height=HEIGHT, width=width)
        again = check_pair(left[:, :-shift], right[:, shift:], mended)
        assert "toed_in" not in names(again), str(again)
        assert f"cx1 - cx0 is then {mended.doffs:g} px" in found["toed_in"].message
        assert again.measured["disparity_low"] > -0.5


@pytest.mark.parametrize("index", GOOD)
@pytest.mark.parametrize("kind", ["lens", "keystone"])
def test_a_distorted_view_is_unrectified(index, kind):
    left, right = pair(index)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32) - np.array([[[HEIGHT / 2]], [[WIDTH / 2]]], np.float32)
    # a lens that was not corrected, or a camera that looks to the side
    factor = 1 + (3e-6 * (x**2 + y**2) if kind == "lens" else 1e-3 * x)
    columns, rows = (x * factor + WIDTH / 2, y * factor + HEIGHT / 2)
    check = check_pair(left, cv2.remap(right, columns, rows, cv2.INTER_LINEAR))
    assert check.severity == "unusable"
    # a lens changes the size of what is seen, most of all
    assert ("unrectified" if kind == "keystone" else "zoom") in names(check), str(check)


@pytest.mark.parametrize(("most", "scale"), [(36, None), (24, True), (8, True)])
def test_a_range_too_small_names_the_scale_that_helps(most, scale):
    left, right = pair(4)
    high = check_pair(left, right).measured["disparity_high"]
    check = check_pair(left, right, max_disparity=most * high / 32)
    assert ("range" in names(check)) == bool(scale)
    if scale:
        message = check.findings[0].message
        factor = float(message.split("--scale ")[1].split()[0])
        assert factor * high <= THRESHOLDS.range_part * most * high / 32
        assert (factor + 0.05) * high > THRESHOLDS.range_part * most * high / 32
    with pytest.raises(InputError, match="max_disparity"):
        check_pair(left, right, max_disparity=0)


def test_the_calibration_is_checked():
    left, right = pair(1)
    other = Calibration(300.0, 0.1, 160.0, 160.0, 2 * WIDTH, 2 * HEIGHT)
    check = check_pair(left, right, other)
    assert names(check) == ["calibration_size"]
    assert check.severity == "unusable"
    assert "640 x 480 pixels, these have 320 x 240" in str(check)
    behind = Calibration(300.0, 0.1, 160.0, 100.0, WIDTH, HEIGHT)
    check = check_pair(left, right, behind)
    assert names(check) == ["calibration"]
    assert "cx1 - cx0 = -60 px, puts 100% of the matches behind" in str(check)


def test_twelve_bits_in_sixteen(tmp_path):
    left, right = (view.astype(np.uint16) * 16 for view in pair(1))
    check = check_pair(left, right)
    assert names(check) == ["bit_depth", "bit_depth"]
    assert "as images of 12 bits do: multiply its samples by 16" in check.findings[0].message
    assert names(check_pair(left * 16, right * 16)) == []
    # one view of 8 bits, the other of 12 in 16
    assert "bit_depth" in names(check_pair(pair(1)[0], right))


def test_clipped_and_constant_rows():
    left, right = (view.copy() for view in pair(1))
    left[:3] = 7
    right[-20:] = 0
    found = str(check_pair(left, right))
    assert "3 rows at the upper border of the left view hold one value" in found
    assert "20 rows at the lower border of the right view hold one value" in found
    left[:80] = 255
    assert "of the left view is white" in str(check_pair(left, right))


def test_the_picture_shows_the_matches():
    left, right = pair(1)
    check = check_pair(left, shifted(right, 4))
    picture = matches_picture(check, left, right)
    assert picture.shape == (HEIGHT, 2 * WIDTH, 3)
    assert picture.dtype == np.uint8
    changed = (picture != np.concatenate([left, right], axis=1)).any(axis=2)
    assert 0.05 < changed.mean() < 0.95
    assert (picture == (255, 40, 40)).all(axis=2).any()  # red: four rows apart
    good = matches_picture(check_pair(left, right), left, right)
    assert (good == (40, 200, 40)).all(axis=2).sum() > 10 * (good == (255, 40, 40)).all(axis=2).sum()
    with pytest.raises(InputError, match="two images of one shape"):
        matches_picture(check, left, right[1:])
    empty = check_pair(left, np.zeros_like(right))
    assert matches_picture(empty, left, right).shape == picture.shape


REAL = {
    "eth3d": ("real/eth3d/terrace", "im0.png", "im1.png"),
    "teddy": ("real/middlebury/teddy", "imL.png", "imR.png"),
    "tsukuba": ("real/middlebury/tsukuba", "imL.png", "imR.png"),
    "Baby": ("real/middlebury/Baby", "left.png", "right.png"),
    "Cloth3": ("real/middlebury/Cloth3", "view1.png", "view5.png"),
    "Motorcycle": ("real/middlebury/Motorcycle", "motorcycle_left.png", "motorcycle_right.png"),
    "kitti": ("real/kitti2012/training", "image_0/000027_10.png", "image_1/000027_10.png"),
    "street": ("demo/kitti_street", "left.png", "right.png"),
    "playtable": ("demo/playtable", "left.png", "right.png"),
}


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_no_false_alarm_on_real_pairs(name):
    folder, *files = REAL[name]
    left, right = (read_image(SHARED / "data" / folder / file) for file in files)
    check = check_pair(left, right)
    assert check.severity == "good", str(check)
    assert names(check_pair(right, left))[0] == "swapped"
    assert "vertical_shift" in names(check_pair(left, shifted(right, 3)))
    degrees = 0.9
    check = check_pair(left, turned(right, degrees))
    assert "roll" in names(check)
    assert np.degrees(np.arcsin(check.measured["roll"] / left.shape[1])) == pytest.approx(degrees, abs=0.15)


@needs_shared
def test_a_pair_of_kitti_that_is_a_pixel_off_is_a_warning():
    folder = SHARED / "data" / "real" / "kitti2012" / "training"
    check = check_pair(folder / "image_0" / "000138_10.png", folder / "image_1" / "000138_10.png")
    assert check.severity == "warning"
    assert 1 < check.measured["row_offset"] < 2


@needs_shared
def test_pairs_that_people_brought():
    case = SHARED / "cases" / "unmatchable_pairs"
    left, right, lower = (case / f"{name}.png" for name in ("left", "right", "right_4px_lower"))
    assert check_pair(left, right).severity == "good"
    assert names(check_pair(right, left)) == ["swapped"]
    assert names(check_pair(left, left)) == ["same_image"]
    assert names(check_pair(left, lower)) == ["vertical_shift"]
    case = SHARED / "cases" / "twelve_bits_in_sixteen"
    assert "bit_depth" in names(check_pair(case / "left.png", case / "right.png"))
