"""Small pairs with saved results, and a matcher that costs nothing."""

import numpy as np
import torch
from torch import nn

from stereokit import StereoOutput
from stereokit.calibration import Calibration
from stereokit.data import write_image
from stereokit.data.pairs import match_pairs
from stereokit.inference import DisparityResult

HEIGHT, WIDTH = 48, 80
CAMERA = Calibration(fx=100.0, baseline=0.1, cx0=39.0, cx1=41.0, cy=24.0, height=HEIGHT, width=WIDTH)


class Columns(nn.Module):
    """A network that says the same of every pair: 4 px, and 8 px from column 40 on."""

    def forward(self, left, right):
        disparity = torch.full_like(left[:, 0], 4.0, dtype=torch.float32)
        disparity[..., 40:] = 8.0
        return StereoOutput(disparity, confidence=torch.full_like(disparity, 0.75))


def save_pairs(folder, names=("a", "b")):
    """Images `NAME_left.png`, `NAME_right.png` and results in `results/`, of 4 px, 8 px from column 40 on, one unknown
    pixel at (5, 3)."""
    rng = np.random.default_rng(0)
    (folder / "results").mkdir(parents=True)
    for name in names:
        left, right = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
        write_image(folder / f"{name}_left.png", left)
        write_image(folder / f"{name}_right.png", right)
        DisparityResult(disparity(), confidence(), 0.1).save(folder / "results" / f"{name}_disparity.npz")
    return match_pairs(str(folder / "*_left.png"), str(folder / "*_right.png"))


def disparity():
    result = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    result[:, 40:] = 8.0
    result[3, 5] = np.nan
    return result


def confidence():
    return np.linspace(0, 1, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
