"""Both views of a scene, with ground truth and occlusion masks."""

from dataclasses import dataclass

import cv2
import numpy as np

from stereokit.data.datasets.dataset import Mask
from stereokit.data.synthetic.scene import Layer, Scene, View, hidden
from stereokit.data.synthetic.surfaces import Array
from stereokit.data.synthetic.textures import Image

__all__ = ["RenderedView", "render_view"]


@dataclass(frozen=True, eq=False)
class RenderedView:
    """What one camera sees.

    Attributes:
        image: (H, W, 3) uint8.
        disparity: (H, W) float32, of the surface at the centre of each pixel.
        nonocc: (H, W) bool, True where the other camera sees that point too.
    """

    image: Image
    disparity: Array
    nonocc: Mask


def render_view(scene: Scene, view: View) -> RenderedView:
    """Renders a view of a scene.

    A pixel shows the surface at its centre. Where an outline passes through it, that surface and the one behind are
    blended by the covered part, as in a camera; the disparity is that of the one at the centre.
    """
    height, width = scene.size
    image = np.zeros((height, width, 3), np.uint8)
    disparity = np.full((height, width), -np.inf, np.float32)
    for layer in scene.layers:
        _draw(layer, view, image, disparity)
    return RenderedView(image, disparity, ~hidden(scene, view, disparity))


def _draw(layer: Layer, view: View, image: Image, disparity: Array) -> None:
    height, width = disparity.shape
    rows, columns = layer.window(view, (height, width))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    v = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
    x = np.arange(columns.start, columns.stop, dtype=np.float32)
    x = np.broadcast_to(x, (len(v), len(x)))
    u, nearer, outside = layer.seen(x, v, view)
    canvas, depths = image[rows, columns], disparity[rows, columns]
    front = nearer > depths
    if outside is None:
        inside = front
    else:
        inside = front & (outside < 0)
        edge = np.nonzero(front & (np.abs(outside) < 0.5))
    colours = layer.colours(x, u, v, nearer, view)
    if outside is not None:
        covered = (np.float32(0.5) - outside[edge])[:, None]
        behind = canvas[edge]
        blended = np.rint(behind + covered * (colours[edge].astype(np.float32) - behind))
    mask = inside.view(np.uint8)
    cv2.copyTo(colours, mask, canvas)  # many times quicker than numpy's
    if outside is not None:
        canvas[edge] = blended
    cv2.copyTo(nearer, mask, depths)
