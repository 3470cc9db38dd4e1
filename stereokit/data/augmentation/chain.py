"""The augmentations one after another, as training uses them."""

from dataclasses import dataclass

import numpy as np

from stereokit.data.augmentation.appearance import colour_jitter, random_occlusion
from stereokit.data.augmentation.geometry import flip_and_swap, random_crop, random_scale, vertical_jitter
from stereokit.data.datasets.dataset import StereoSample
from stereokit.errors import InputError

__all__ = ["Augmentation"]


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Random changes of a pair for training: scale, flip, crop, colour, vertical jitter and occlusion, in
    this order.

    What it does hangs on the sample and the generator alone. For training that can be repeated whatever the
    number of workers, make the generator from the seed, the epoch and the index:
    `np.random.default_rng([seed, epoch, index])`.

    Attributes:
        crop_height: size of the result in pixels.
        crop_width: the same.
        scale_range: smallest and largest factor; (1, 1) keeps the size. A pair too small for the crop is
            enlarged.
        flip: how often views are mirrored and swapped.
        colour: how often colours change.
        colour_apart: how often they change in each view by itself, where they change.
        colour_strength: half range of the factors of brightness, contrast and saturation. Gamma has half of
            it.
        vertical_jitter: most pixels that the right view is moved up or down; 0 does not.
        occlusion: how often a rectangle of the right view is hidden.

    Raises:
        InputError: a size that is not positive, or a probability outside [0, 1].

    >>> pair = StereoSample("a", np.zeros((40, 80, 3), np.uint8), np.zeros((40, 80, 3), np.uint8))
    >>> augment = Augmentation(crop_height=32, crop_width=64, colour=1.0)
    >>> augment(pair, np.random.default_rng([0, 0, 0])).left.shape
    (32, 64, 3)
    """

    crop_height: int
    crop_width: int
    scale_range: tuple[float, float] = (1.0, 1.0)
    flip: float = 0.0
    colour: float = 0.0
    colour_apart: float = 0.2
    colour_strength: float = 0.4
    vertical_jitter: float = 0.0
    occlusion: float = 0.0

    def __post_init__(self) -> None:
        if self.crop_height < 1 or self.crop_width < 1:
            raise InputError(f"Augmentation: can't crop to {self.crop_width} x {self.crop_height} pixels")
        for name in ("flip", "colour", "colour_apart", "occlusion"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"Augmentation: {name} is a probability from 0 to 1, got {getattr(self, name)}")

    def __call__(self, sample: StereoSample, rng: np.random.Generator) -> StereoSample:
        """The changed pair, of the size of the crop."""
        sample = random_scale(
            sample,
            rng,
            lowest=self.scale_range[0],
            highest=self.scale_range[1],
            min_height=self.crop_height,
            min_width=self.crop_width,
        )
        if rng.random() < self.flip:
            sample = flip_and_swap(sample)
        sample = random_crop(sample, rng, height=self.crop_height, width=self.crop_width)
        if rng.random() < self.colour:
            sample = colour_jitter(
                sample,
                rng,
                brightness=self.colour_strength,
                contrast=self.colour_strength,
                saturation=self.colour_strength,
                gamma=self.colour_strength / 2,
                apart=rng.random() < self.colour_apart,
            )
        if self.vertical_jitter:
            sample = vertical_jitter(sample, rng, largest=self.vertical_jitter)
        if rng.random() < self.occlusion:
            sample = random_occlusion(sample, rng)
        return sample
