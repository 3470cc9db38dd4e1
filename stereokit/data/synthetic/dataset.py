"""Synthetic scenes as a data set that has no files."""

from pathlib import Path

import numpy as np

from stereokit.data.datasets.dataset import StereoSample
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.synthetic.composition import Composition
from stereokit.data.synthetic.photometry import Cameras
from stereokit.data.synthetic.render import render_view
from stereokit.data.synthetic.scene import Scene
from stereokit.data.synthetic.textures import TextureBank
from stereokit.errors import ConfigError

__all__ = ["SyntheticScenes"]


class SyntheticScenes:
    """Random scenes of textured surfaces, rendered when they are asked for, with exact ground truth of both views.

    Item i is the same whenever and in whatever process it is drawn: it hangs on the seed, i and the settings alone.
    It is what `torch.utils.data.DataLoader` takes for a map-style data set.

    Args:
        seed: of all that is random.
        size: height and width of the views in pixels.
        max_disparity: the largest disparity there is, in pixels. The sky has next to none.
        disparity_exponent: 1 spreads the disparity of things evenly, more makes most things far.
        range_exponent: 0 gives all scenes the same largest disparity, more makes most scenes far as a whole, see
            `Composition`.
        objects: fewest and most things in a scene, besides its walls, ground and sky.
        thin: the part of them that is thin: bars, wires, lattices, plants.
        alike: the part of the surfaces that has the texture of another one.
        shaded: the part of the surfaces that is lit unevenly or lies in part in shadow.
        glossy: the part of the surfaces that mirrors something, which moves between the views by another disparity.
        plain: how often surfaces have next to no texture: 1 as often as is usual, 0 never.
        photometric: strength of the differences between the cameras (gain, gamma, colour, vignetting, blur, noise, rows
            a little apart); 0 has none.
        textures: a folder of photographs to use besides procedural textures.
        count: how many scenes there are; as many as one likes, for each is drawn from its own number.

    Raises:
        ConfigError: a setting out of range.
        InputError: the folder holds no image, or one that can't be read.

    >>> scenes = SyntheticScenes(seed=0, size=(64, 96), max_disparity=24)
    >>> pair = scenes[7]
    >>> pair.left.shape, pair.disparity.shape, bool(pair.disparity.max() <= 24)
    ((64, 96, 3), (64, 96), True)
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        size: tuple[int, int] = (256, 512),
        max_disparity: float = 96.0,
        disparity_exponent: float = 1.3,
        range_exponent: float = 0.0,
        objects: tuple[int, int] = (3, 13),
        thin: float = 0.3,
        alike: float = 0.0,
        shaded: float = 0.0,
        glossy: float = 0.0,
        plain: float = 1.0,
        photometric: float = 1.0,
        textures: "PathLike | None" = None,
        count: int = 1_000_000,
    ) -> None:
        if seed < 0 or count < 1 or not 0 <= photometric <= 2:
            raise ConfigError(
                "synthetic scenes need a seed of at least 0, a count of at least 1 and a photometric strength "
                f"from 0 to 2, got {seed}, {count} and {photometric}"
            )
        self.composition = Composition(
            size=size,
            max_disparity=max_disparity,
            disparity_exponent=disparity_exponent,
            range_exponent=range_exponent,
            objects=objects,
            thin=thin,
            alike=alike,
            shaded=shaded,
            glossy=glossy,
        )
        self.seed = seed
        self._count = count
        self.cameras = Cameras(seed, photometric)
        self.bank = TextureBank(seed, plain=plain, photographs=None if textures is None else Path(textures))

    def __len__(self) -> int:
        return self._count

    def scene(self, index: int) -> Scene:
        """The geometry of item `index`."""
        return self.composition.scene(self._generator(index, 0), self.bank)

    def __getitem__(self, index: int) -> StereoSample:
        index = range(self._count)[index]
        scene = self.scene(index)
        left, right = render_view(scene, "left"), render_view(scene, "right")
        sample = StereoSample(
            f"{self.seed}-{index:06d}",
            left.image,
            right.image,
            left.disparity,
            left.nonocc,
            right_disparity=right.disparity,
            right_nonocc=right.nonocc,
        )
        return self.cameras(sample, self._generator(index, 1))

    def _generator(self, index: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1, index, purpose)))
