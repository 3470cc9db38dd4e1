"""How two cameras differ: gain, gamma, colour, vignetting, blur, noise, a small error of rectification."""

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.augmentation.geometry import shift_right_view
from stereokit.data.datasets.dataset import StereoSample
from stereokit.data.images import to_uint8
from stereokit.data.synthetic.surfaces import Array
from stereokit.data.synthetic.textures import Image

__all__ = ["Cameras"]

_LUMA = np.array([[0.299, 0.587, 0.114]] * 3, np.float32)  # of ITU-R BT.601
_NOISE = 1 << 21


class Cameras:
    """Takes a rendered pair with two cameras that are not quite alike.

    Args:
        seed: of the noise, which is drawn once and used from a random place on.
        strength: scales all differences; 0 leaves the pair as it is.
    """

    def __init__(self, seed: int, strength: float = 1.0) -> None:
        self.strength = strength
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
        self._noise: Array = rng.standard_normal(_NOISE, dtype=np.float32)

    def __call__(self, sample: StereoSample, rng: np.random.Generator) -> StereoSample:
        """The pair as these cameras see it. Geometry and ground truth stay, but for rows of the right view."""
        strength = self.strength
        if strength == 0:
            return sample
        common, apart = strength * 0.25, strength * 0.08 * min(rng.exponential(), 2.5)
        tone = np.exp(rng.normal((-0.4 * common, 0.0), common))
        colour = np.exp(rng.normal(0, 0.3 * common, 3))
        grey = rng.random() < 0.12
        blur, noise = rng.choice((0.0, rng.uniform(0.3, 1.0)), p=(0.4, 0.6)), strength * 4 * rng.exponential()
        vignette = strength * rng.uniform(0, 0.5) if rng.random() < 0.25 else 0.0
        views = []
        for image in (sample.left, sample.right):
            gain, gamma = tone * np.exp(rng.normal(0, apart, 2))
            view = _tone(image, gain * colour * np.exp(rng.normal(0, 0.4 * apart, 3)), gamma)
            if grey:
                view = np.asarray(cv2.transform(view, _LUMA), np.uint8)
            sigma = blur + strength * rng.uniform(-0.15, 0.15) if blur else 0.0
            if sigma > 0.2:
                view = np.asarray(cv2.GaussianBlur(view, (0, 0), sigma), np.uint8)
            views.append(self._expose(view, rng, vignette * rng.uniform(0.8, 1.2), noise * rng.uniform(0.8, 1.2), grey))
        pair = replace(sample, left=views[0], right=views[1])
        if rng.random() < 0.3:
            pair = shift_right_view(pair, down=strength * 0.4 * float(rng.standard_normal()))
        return pair

    def _expose(self, image: Image, rng: np.random.Generator, vignette: float, noise: float, grey: bool) -> Image:
        values: npt.NDArray[np.float32] = image.astype(np.float32)
        height, width = image.shape[:2]
        if vignette:
            y = np.linspace(-1, 1, height, dtype=np.float32)[:, None] ** 2
            x = np.linspace(-1, 1, width, dtype=np.float32)[None] ** 2
            values *= (1 - np.float32(vignette / 2) * (x + y))[:, :, None]
        count = height * width * (1 if grey else 3)
        if count < _NOISE:
            start = int(rng.integers(_NOISE - count))
            field = self._noise[start : start + count]
        else:
            field = rng.standard_normal(count, dtype=np.float32)
        values += np.float32(noise) * field.reshape(height, width, -1)
        values += np.float32(0.5)
        return np.clip(values, 0, 255, out=values).astype(np.uint8)


def _tone(image: Image, gain: npt.NDArray[np.float64], gamma: float) -> Image:
    values = np.linspace(0, 1, 256)[:, None] ** gamma * gain
    table = to_uint8(values)
    return np.asarray(cv2.LUT(image, table[None]), np.uint8)
