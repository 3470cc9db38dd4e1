"""Small data sets whose disparity is known, and matchers whose errors are."""

from pathlib import Path

import numpy as np

from stereokit.data import write_disparity, write_image, write_kitti_png

SIZE = (40, 60)


def save_scene(root, name, disparity=6, size=SIZE, seed=0):
    """A pair of noise that is shifted by whole pixels, with its ground truth, unknown where it left the right image."""
    right = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    left = np.roll(right, disparity, axis=1)
    truth = np.full(size, disparity, np.float32)
    truth[:, :disparity] = np.nan
    folder = Path(root) / name
    folder.mkdir(parents=True)
    write_image(folder / "left.png", left)
    write_image(folder / "right.png", right)
    write_disparity(folder / "disparity.pfm", truth)
    return truth


def save_kitti(root, year, part, numbers=range(2), size=SIZE):
    """KITTI's layout, as far as it is needed to match; ground truth for the training part."""
    views = {"2012": ("image_0", "image_1"), "2015": ("image_2", "image_3")}[year]
    truths = {"2012": ("disp_occ", "disp_noc"), "2015": ("disp_occ_0", "disp_noc_0")}[year]
    rng = np.random.default_rng(0)
    for number in numbers:
        for folder in (*views, *(truths if part == "training" else ())):
            path = Path(root) / part / folder
            path.mkdir(parents=True, exist_ok=True)
            name = path / f"{number:06d}_10.png"
            if folder in views:
                write_image(name, rng.integers(0, 256, (*size, 3), dtype=np.uint8))
            else:
                write_kitti_png(name, np.full(size, 5.0))


def constant(disparity):
    """A matcher that always says the same."""

    def match(left, right):
        return np.full(left.shape[:2], disparity, np.float32)

    return match


class Batches:
    """A matcher that takes batches, says 1, 2, 3, ... for the images it sees, and remembers how they came."""

    def __init__(self):
        self.sizes = []

    def __call__(self, left, right):
        return self.match_batch([left], [right])[0]

    def match_batch(self, lefts, rights):
        assert len({left.shape for left in lefts}) == 1
        self.sizes.append(len(lefts))
        return [left[..., 0].astype(np.float32) for left in lefts]
