"""How far tiles differ from the whole pair, by the distance from a tile's edge, and what blending leaves of it.

    python benchmarks/tile_seams.py --weights coex.synthetic_v7

The pair is a textured surface without edges: disparities of 20 to 70 px. The overlap of `match_tiles` follows from it.
"""

import argparse
import sys

import cv2
import numpy as np
import torch
from torch import Tensor

from stereokit import StereoKitError, StereoModel
from stereokit.inference.tiles import match_tiles, tile_grid
from stereokit.tables import Table
from stereokit.weights import load_weights

DISTANCES = (0, 16, 32, 64, 96)
BAND = 8
"""Pixels over which the error at a distance is averaged."""


def smooth_pair(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Left and right image (1, 3, H, W) and the disparity (H, W)."""
    rng = np.random.default_rng(0)
    texture = np.zeros((height, width, 3), np.float32)
    for step in (1, 2, 4, 8, 16):
        noise = rng.random((height // step + 2, width // step + 2, 3), dtype=np.float32)
        texture += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) * (0.5 if step < 3 else 1)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = 40 + 20 * np.sin(5 * x / width) + 10 * y / height
    left = cv2.remap(texture, x - disparity, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    left, right = (torch.from_numpy(view).clamp(0, 1).permute(2, 0, 1)[None] for view in (left, texture))
    return left, right, torch.from_numpy(disparity)


def edges(model: StereoModel) -> Table:
    """A part in the middle of the pair, against the same part of the whole."""
    left, right, _ = smooth_pair(512, 1280)
    whole = model(left, right).disparity[0]
    top, stop = 128, 960
    # the part begins far to the left, so that its pixels have partners
    rows = []
    at_right = (model(left[..., :stop], right[..., :stop]).disparity[0] - whole[:, :stop]).abs()
    at_top = (model(left[..., top:, :], right[..., top:, :]).disparity[0] - whole[top:]).abs()
    for distance in DISTANCES:
        # what lies left of D has no partner
        columns = at_right[:, stop - distance - BAND : stop - distance]
        lines = at_top[distance : distance + BAND, model.max_disparity :]
        rows.append((str(distance), *(f"{value:.3f}" for band in (columns, lines) for value in summary(band))))
    return Table(("distance [px]", "right, mean", "right, 99 %", "top, mean", "top, 99 %"), tuple(rows))


def summary(errors: Tensor) -> tuple[float, float]:
    return errors.mean().item(), errors.flatten().quantile(0.99).item()


def seams(model: StereoModel) -> str:
    """What 2 x 2 tiles differ from the whole pair by, with and without overlap."""
    left, right, truth = smooth_pair(448, 1056)
    visible = truth < torch.arange(1056)
    whole = model(left, right).disparity[0]
    said = []
    for overlap, tile in ((128, (288, 736)), (0, (256, 672))):
        place = {"max_disparity": model.max_disparity, "multiple": model.multiple, "overlap": overlap}
        rows, columns = tile_grid((448, 1056), tile, **place)
        tiled = match_tiles(model, left, right, tile=tile, **place).disparity[0]
        worst = (tiled - whole).abs()[visible].quantile(0.999).item()
        said.append(f"overlap {overlap} px, {len(rows)} x {len(columns)} tiles: 99.9 % of pixels within {worst:.3f} px")
    return "\n".join(said)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="coex.synthetic_v7", help="shipped ones (default: %(default)s)")
    try:
        model = load_weights(parser.parse_args().weights).eval()
    except StereoKitError as error:
        print(f"tile_seams: {error}", file=sys.stderr)
        return 2
    with torch.inference_mode():
        print(edges(model))
        print(seams(model))
    return 0


if __name__ == "__main__":
    sys.exit(main())
