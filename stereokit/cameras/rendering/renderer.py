"""What the two cameras of a rig see of planes."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.rectification import Rectification
from stereokit.cameras.rendering.planes import Plane, hit
from stereokit.cameras.rig import Camera, Rig

__all__ = ["RigRenderer", "rectified_depth"]

_BACKGROUND = 110.0


class RigRenderer:
    """Renders what the cameras of a rig see: distorted, blurred, and with noise.

    Args:
        rig: both cameras.
        samples: of a pixel along each side, which are averaged.
        blur: standard deviation of the optics' blur in pixels.
        noise: standard deviation of the noise in grey levels.

    >>> from stereokit.cameras.rendering import example_rig
    >>> wall = Plane(np.full((9, 9), 200, np.uint8), 3.0, np.eye(3), np.array([0.0, 0.0, 1.0]))
    >>> left, right = RigRenderer(example_rig(size=(48, 64)), samples=1)([wall], seed=0)
    >>> left.shape, round(float(right.mean()))
    ((48, 64), 200)
    """

    def __init__(self, rig: Rig, *, samples: int = 3, blur: float = 0.6, noise: float = 2.0) -> None:
        self.rig = rig
        self.samples = samples
        self.blur = blur
        self.noise = noise
        self._rays = [_rays(camera, samples) for camera in (rig.left, rig.right)]

    def __call__(self, planes: Sequence[Plane], *, seed: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        """Both views of planes given in the axes of the left camera.

        Args:
            planes: pictures of one kind, all grey or all colour.
            seed: of the noise.

        Returns:
            Two (H, W) or (H, W, 3).
        """
        rng = np.random.default_rng(seed)
        rotation, translation = np.reshape(self.rig.rotation, (3, 3)), np.array(self.rig.translation)
        left = self._view(planes, self.rig.left, self._rays[0], rng)
        moved = [plane.moved(rotation, translation) for plane in planes]
        return left, self._view(moved, self.rig.right, self._rays[1], rng)

    def _view(
        self, planes: Sequence[Plane], camera: Camera, rays: npt.NDArray[np.float64], rng: np.random.Generator
    ) -> npt.NDArray[np.uint8]:
        colour = planes[0].picture.shape[2:]
        seen = np.full((*rays.shape[:2], *colour), _BACKGROUND, np.float32)
        nearest = np.full(rays.shape[:2], np.inf)
        for plane in planes:
            window = self._window(plane, camera)
            depth, columns, rows = plane.meet(rays[window])
            if not depth.size:
                continue
            front = depth < nearest[window]
            drawn = cv2.remap(
                plane.picture,
                columns.astype(np.float32),
                rows.astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            seen[window][front] = drawn[front]
            nearest[window][front] = depth[front]
        image = seen.reshape(camera.height, self.samples, camera.width, self.samples, *colour).mean(axis=(1, 3))
        image = cv2.GaussianBlur(image, (0, 0), self.blur) + rng.normal(0, self.noise, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def _window(self, plane: Plane, camera: Camera) -> tuple[slice, slice]:
        """The samples that may show a plane: all of them where it reaches far to the side, for lenses fold there."""
        outline = plane.outline()
        if (np.abs(outline[:, :2]) > outline[:, 2:]).any():
            return slice(None), slice(None)
        x, y = (camera.project(outline).T * self.samples).round()
        margin = 2 * self.samples
        return _reach(y, margin), _reach(x, margin)


def _reach(places: npt.NDArray[np.float64], margin: int) -> slice:
    return slice(max(int(places.min()) - margin, 0), max(int(places.max()) + margin, 0))


def rectified_depth(rectification: Rectification, planes: Sequence[Plane]) -> npt.NDArray[np.float64]:
    """True depth (H, W) in metres of planes in the rectified left view, NaN where there is none.

    Args:
        rectification: of any rig, such as one that was calibrated.
        planes: in the axes of the left camera.
    """
    camera = rectification.calibration
    height, width = rectification.left_valid.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rectified = np.stack([(x - camera.cx0) / camera.fx, (y - camera.known_cy()) / camera.fy, np.ones(x.shape)], axis=-1)
    rays = rectified @ rectification.left_rotation
    # depth along the axis of the left camera, to that along the rectified one
    depth = hit(planes, rays / rays[..., 2:]) / rays[..., 2]
    return np.where(np.isfinite(depth), depth, np.nan)


def _rays(camera: Camera, samples: int) -> npt.NDArray[Any]:
    """Directions (H s, W s, 3) of s x s samples in each pixel."""
    x = (np.arange(camera.width * samples) + 0.5) / samples - 0.5
    y = (np.arange(camera.height * samples) + 0.5) / samples - 0.5
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    return camera.rays(grid.reshape(-1, 2)).reshape(*grid.shape[:2], 3)
