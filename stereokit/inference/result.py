"""The disparity of one pair, and its files."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.calibration import Calibration
from stereokit.cameras.cloud import PointCloud, point_cloud
from stereokit.cameras.depth import Depth, depth_from_disparity
from stereokit.data.disparity_files import read_disparity, write_disparity
from stereokit.data.disparity_png import fits_kitti_png
from stereokit.data.images import write_image
from stereokit.data.npy import npz_holds, read_npz, save_arrays
from stereokit.errors import InputError, printable
from stereokit.files import atomic_path, check_free, make_folder
from stereokit.pictures import picture_with_scale

__all__ = ["DisparityResult"]


@dataclass(frozen=True, eq=False)
class DisparityResult:
    """The disparity of one pair.

    Args:
        disparity: (H, W) float32, pixels of the left image; x_right = x_left - disparity.
        confidence: (H, W) float32 in [0, 1], the probability mass behind the estimate; None if the network gives none.
        seconds: that the network took, with the transfer to and from the device.
        preparation_seconds: that went before it into what is needed once, or once for a size: compiling, finding out
            how much memory it takes.

    >>> result = DisparityResult(np.full((40, 60), 12.5, np.float32), confidence=None, seconds=0.1)
    >>> result.size
    (40, 60)
    """

    disparity: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32] | None
    seconds: float
    preparation_seconds: float = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, those of the input."""
        height, width = self.disparity.shape
        return height, width

    @property
    def invalid(self) -> int:
        """How many pixels have no finite disparity; networks in order give 0."""
        return int(np.count_nonzero(~np.isfinite(self.disparity)))

    @property
    def known_range(self) -> tuple[float, float] | None:
        """The smallest and the largest finite disparity; None where none is."""
        known = self.disparity[np.isfinite(self.disparity)]
        return (float(known.min()), float(known.max())) if known.size else None

    @property
    def mean_confidence(self) -> float | None:
        """Of the pixels whose disparity is finite; None without any, or without a confidence."""
        known = np.isfinite(self.disparity)
        return None if self.confidence is None or not known.any() else float(self.confidence[known].mean())

    def trusted(
        self, *, min_confidence: float | None = None, valid: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.bool_]:
        """The pixels whose disparity is finite, within `valid`, and of at least this confidence; (H, W).

        Raises:
            InputError: a confidence out of range, or one that the network does not give.
        """
        kept = np.isfinite(self.disparity) if valid is None else np.isfinite(self.disparity) & valid
        if min_confidence is None:
            return kept
        if not 0 <= min_confidence <= 1:
            raise InputError(f"min_confidence is a share from 0 to 1, got {min_confidence}")
        if self.confidence is None:
            raise InputError("min_confidence needs a confidence, which this network does not give; leave it out")
        return kept & (self.confidence >= min_confidence)

    def masked(self, valid: npt.NDArray[np.bool_]) -> "DisparityResult":
        """The same without the disparity outside of `valid` (H, W), which becomes NaN, of no confidence.

        >>> result = DisparityResult(np.ones((2, 2), np.float32), confidence=None, seconds=0.1)
        >>> result.masked(np.eye(2, dtype=bool)).disparity.tolist()
        [[1.0, nan], [nan, 1.0]]
        """
        disparity = np.where(valid, self.disparity, np.float32(np.nan))
        confidence = None if self.confidence is None else np.where(valid, self.confidence, np.float32(0))
        return replace(self, disparity=disparity, confidence=confidence)

    def depth(
        self,
        calibration: Calibration,
        *,
        min_confidence: float | None = None,
        valid: npt.NDArray[np.bool_] | None = None,
        max_depth: float | None = None,
    ) -> Depth:
        """Depth along the optical axis of the left camera, Z = baseline fx / (d + cx1 - cx0).

        Args:
            calibration: of images of this size.
            min_confidence: pixels below it become unknown.
            valid: (H, W), False where pixels become unknown.
            max_depth: in metres; what is farther becomes unknown.

        Returns:
            (H, W) float32 in metres, NaN where unknown.

        Raises:
            InputError: a calibration or a mask of another size, or values out of range.

        >>> result = DisparityResult(np.full((40, 60), 12.5, np.float32), confidence=None, seconds=0.1)
        >>> camera = Calibration(fx=500.0, baseline=0.1, cx0=30.0, cx1=30.0)
        >>> result.depth(camera).max().item()
        4.0
        """
        kept = self.trusted(min_confidence=min_confidence, valid=valid)
        return depth_from_disparity(self.disparity, calibration, valid=kept, max_depth=max_depth)

    def point_cloud(self, calibration: Calibration, image: npt.NDArray[Any], **options: Any) -> PointCloud:
        """The points that the left camera sees, see `stereokit.cameras.cloud.point_cloud`.

        Args:
            calibration: of images of this size, with cy.
            image: the left one, (H, W, 3), uint8 or floating-point in [0, 1].
            options: `min_confidence`, `valid`, `edge_filter`, `holes`, `max_depth`, `axes`.
        """
        return point_cloud(self.disparity, calibration, image, confidence=self.confidence, **options)

    def picture(self, value_range: tuple[float, float] | None = None) -> npt.NDArray[np.uint8]:
        """The disparity in colours above its scale, RGB."""
        return picture_with_scale(self.disparity, value_range=value_range)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> "DisparityResult":
        """A result from a file that `save` wrote, or from another disparity file, see `read_disparity`.

        Its confidence comes from .npz alone. Unknown pixels are NaN, and `seconds` is NaN too.

        Raises:
            InputError: a file that can't be read; or confidence of another size, or outside of [0, 1].

        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.npz"
        >>> DisparityResult(np.ones((2, 3), np.float32), np.full((2, 3), 0.5, np.float32), 0.1).save(path)
        >>> float(DisparityResult.read(path).confidence.mean())
        0.5
        """
        disparity, confidence = read_disparity(path), None
        if npz_holds(path, "confidence"):
            confidence = read_npz(path, entry="confidence")
            if confidence.shape != disparity.shape or not (confidence.min() >= 0 and confidence.max() <= 1):
                raise InputError(
                    f"{printable(path)}: expected confidence in [0, 1] of shape {disparity.shape}, got shape "
                    f"{confidence.shape}, {confidence.min():g} to {confidence.max():g}"
                )
        return cls(disparity, confidence, seconds=float("nan"))

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the disparity in the format that the suffix names.

        Args:
            path: ends in .png (16 bits, KITTI's encoding), .pfm, .npy, or .npz, which holds the confidence too.
            overwrite: replace an existing file.

        Raises:
            InputError: another suffix, a value that the format can't hold, or a file that can't be written.
        """
        if Path(path).suffix.lower() != ".npz":
            write_disparity(path, self.disparity, overwrite=overwrite)
            return
        arrays: dict[str, Any] = {"disparity": self.disparity}
        if self.confidence is not None:
            arrays["confidence"] = self.confidence
        with atomic_path(path, overwrite=overwrite) as temporary:
            save_arrays(temporary, **arrays)

    def save_all(self, folder: str | os.PathLike[str], name: str, *, overwrite: bool = False) -> list[Path]:
        """Writes the disparity in every format, and its picture, beside each other.

        A disparity that KITTI's encoding can't hold, below 0 or from 256 px up, is not written as PNG.

        Args:
            folder: is made if need be.
            name: the files are those of `output_paths`.
            overwrite: replace existing files; a PNG that is not written is removed.

        Returns:
            The files written.

        Raises:
            InputError: a file exists already; then none is written.
        """
        paths = output_paths(folder, name)
        check_free(paths, overwrite=overwrite)
        make_folder(folder)
        kitti, *exact, picture = paths
        encodable = fits_kitti_png(self.disparity)
        disparities = [kitti, *exact] if encodable else exact
        for path in disparities:
            self.save(path, overwrite=overwrite)
        if not encodable:
            # of another result
            try:
                kitti.unlink(missing_ok=True)
            except OSError as error:
                raise InputError(f"{str(kitti)!r} can't be removed: {error.strerror or error}") from error
        write_image(picture, self.picture(), overwrite=overwrite)
        return [*disparities, picture]


def output_paths(folder: str | os.PathLike[str], name: str) -> list[Path]:
    """The files of one pair: 16-bit PNG, PFM, npz, and the picture.

    >>> [path.name for path in output_paths("out", "teddy")]
    ['teddy_disparity.png', 'teddy_disparity.pfm', 'teddy_disparity.npz', 'teddy_picture.png']
    """
    disparities = [Path(folder) / f"{name}_disparity{suffix}" for suffix in (".png", ".pfm", ".npz")]
    return [*disparities, Path(folder) / f"{name}_picture.png"]
