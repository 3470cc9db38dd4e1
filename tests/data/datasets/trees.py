"""Miniature data sets in the layouts in which the real ones lie on disk."""

import numpy as np

from stereokit.data.images import write_samples
from stereokit.data.pfm import write_pfm

SHAPE = (6, 9)
DISPARITY = np.where(np.arange(9) < 3, np.nan, 4.0).astype(np.float32) * np.ones((6, 1), np.float32)
KNOWN = np.isfinite(DISPARITY)


def picture(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), np.uint8)


def save(path, samples):
    """Writes an image, a PFM for floating-point values, or text, and the folders on the way to it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(samples, str):
        path.write_text(samples)
    elif samples.dtype == np.float32:
        write_pfm(path, samples)
    else:
        write_samples(path, samples, overwrite=False)


def save_pair(left, right, seed=0):
    save(left, picture(2 * seed))
    save(right, picture(2 * seed + 1))


def stored(scale, dtype=np.uint16, disparity=DISPARITY):
    """Disparity as whole numbers, 0 where unknown."""
    return np.where(np.isfinite(disparity), disparity * scale, 0).astype(dtype)


def assert_pair(sample, seed=0):
    np.testing.assert_array_equal(sample.left, picture(2 * seed))
    np.testing.assert_array_equal(sample.right, picture(2 * seed + 1))


def assert_truth(sample, disparity=DISPARITY):
    assert sample.disparity.dtype == np.float32
    np.testing.assert_array_equal(sample.disparity, disparity)


KITTI_ROWS = {
    0: "700 0 4 0 0 700 3 0 0 0 1 0",
    1: "700 0 4 -350 0 700 3 0 0 0 1 0",
    2: "700 0 4 70 0 700 3 0 0 0 1 0",
    3: "700 0 4 -350 0 700 3 0 0 0 1 0",
}
CALIB_TXT = """cam0=[700 0 4; 0 700 3; 0 0 1]
cam1=[700 0 5; 0 700 3; 0 0 1]
doffs=1
baseline=100
width=9
height=6
"""


def kitti2012(root, numbers=range(2), views=("image_0", "image_1"), part="training"):
    for number in numbers:
        name = f"{number:06d}_10.png"
        save_pair(root / part / views[0] / name, root / part / views[1] / name, number)
        save_pair(
            root / part / views[0] / f"{number:06d}_11.png",
            root / part / views[1] / f"{number:06d}_11.png",
            99,
        )
        rows = "".join(f"P{camera}: {row}\n" for camera, row in KITTI_ROWS.items())
        save(root / part / "calib" / f"{number:06d}.txt", rows)
        if part == "training":
            visible = np.where(np.arange(9) < 5, np.nan, DISPARITY)
            save(root / part / "disp_occ" / name, stored(256))
            save(root / part / "disp_noc" / name, stored(256, disparity=visible))


def kitti2015(root, numbers=range(2)):
    training = root / "training"
    for number in numbers:
        name = f"{number:06d}_10.png"
        save_pair(training / "image_2" / name, training / "image_3" / name, number)
        save(training / "disp_occ_0" / name, stored(256))
        save(training / "disp_noc_0" / name, stored(256))
        save(training / "obj_map" / name, np.arange(54, dtype=np.uint8).reshape(SHAPE))
        rows = "".join(f"S_rect_0{camera}: 9 6\nP_rect_0{camera}: {row}\n" for camera, row in KITTI_ROWS.items())
        save(training / "calib_cam_to_cam" / f"{number:06d}.txt", rows)
