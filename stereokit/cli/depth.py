"""Depth and point clouds beside the disparity of `stereokit predict`."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from stereokit.calibration import Calibration, read_calibration
from stereokit.cameras.cloud import CLOUD_SUFFIXES, Axes, Holes, PointCloud
from stereokit.cameras.consistency import occluded, right_disparity
from stereokit.cameras.depth import DEPTH_SUFFIXES, Depth, depth_from_disparity, fill_background, write_depth
from stereokit.data.inputs import ImageLike
from stereokit.errors import ConfigError
from stereokit.inference import DisparityResult, Predictor

__all__ = ["DepthFiles", "add_depth_options"]

_Computed: TypeAlias = "tuple[Calibration, npt.NDArray[Any] | None, npt.NDArray[np.bool_] | None] | None"
"""The calibration, the left view and the pixels that the right one sees; None where no file is wanted."""

OF_CLOUDS = ("axes", "edge_filter")
OF_BOTH = ("min_confidence", "max_depth", "holes", "left_right")


def add_depth_options(parser: argparse.ArgumentParser) -> None:
    """What turns disparity into metres."""
    group = parser.add_argument_group("depth", "in metres, from disparity and the cameras' calibration")
    group.add_argument("--calibration", metavar="FILE", help="of the cameras of all pairs, in any format that is known")
    group.add_argument(
        "--rig",
        metavar="FILE",
        help="of 'stereokit calibrate', or Kalibr's: views as the cameras took them are rectified first",
    )
    group.add_argument(
        "--depth",
        nargs="?",
        const="png",
        choices=[suffix.removeprefix(".") for suffix in DEPTH_SUFFIXES],
        help="write depth too: png holds millimetres, the others metres (default: png)",
    )
    group.add_argument(
        "--cloud",
        nargs="?",
        const="ply",
        choices=[suffix.removeprefix(".") for suffix in CLOUD_SUFFIXES],
        help="write a coloured point cloud too (default: ply)",
    )
    group.add_argument(
        "--axes", choices=get_args(Axes), help="of the cloud (default: opencv, x right, y down, z forward)"
    )
    group.add_argument("--min-confidence", type=float, help="leave out pixels of less, from 0 to 1")
    group.add_argument("--max-depth", type=float, help="leave out what is farther, in metres")
    group.add_argument(
        "--edge-filter", type=float, metavar="PX", help="leave out points that fly between surfaces; 1 is a good value"
    )
    group.add_argument(
        "--holes", choices=get_args(Holes), help="leave them (default), or fill them from the background"
    )
    group.add_argument(
        "--left-right",
        action="store_true",
        default=None,
        help="match the right view too, and leave out what it does not see; takes twice the time",
    )


@dataclass(frozen=True)
class DepthFiles:
    """Writes depth and cloud of a pair, as the options say.

    Args:
        options: of `add_depth_options`.
        calibration: None where neither is asked for, or where the rig of the predictor gives it.
    """

    options: argparse.Namespace
    calibration: Calibration | None

    @classmethod
    def of(cls, options: argparse.Namespace) -> "DepthFiles":
        """Checks the options, and reads the calibration.

        Raises:
            ConfigError: options that have no effect, or no calibration.
            InputError: a calibration that can't be read.
        """
        wanted = options.depth is not None or options.cloud is not None
        given = [name for name in (*OF_BOTH, *OF_CLOUDS, "calibration") if getattr(options, name) is not None]
        if given and not wanted:
            raise ConfigError(f"{_flag(given[0])} has no effect without --depth or --cloud; leave it out, or add one")
        of_clouds = [name for name in OF_CLOUDS if getattr(options, name) is not None]
        if of_clouds and options.cloud is None:
            raise ConfigError(f"{_flag(of_clouds[0])} has no effect without --cloud; leave it out, or add it")
        if options.rig is not None and options.calibration is not None:
            raise ConfigError("--calibration has no effect beside --rig, which gives that of the rectified pair")
        if options.rig is not None:
            return cls(options, None)
        if wanted and options.calibration is None:
            raise ConfigError("metres need the cameras' calibration: give --calibration FILE, or --rig FILE")
        return cls(options, read_calibration(options.calibration) if wanted else None)

    @property
    def settings(self) -> dict[str, Any]:
        """The options that were given, and the calibration."""
        given = {name: getattr(self.options, name) for name in ("depth", "cloud", *OF_BOTH, *OF_CLOUDS)}
        settings = {name: value for name, value in given.items() if value is not None}
        return settings if self.calibration is None else {"calibration": self.calibration.to_dict(), **settings}

    def names(self, pair: str) -> list[str]:
        """Of the files of a pair."""
        kinds = (("depth", self.options.depth), ("cloud", self.options.cloud))
        return [f"{pair}_{kind}.{suffix}" for kind, suffix in kinds if suffix is not None]

    def compute(self, predictor: Predictor, left: ImageLike, right: ImageLike, result: DisparityResult) -> _Computed:
        """What the files need of the predictor.

        Raises:
            InputError: a calibration of another size.
        """
        if not self.names(""):
            return None
        return (self.calibration_of(result, predictor), *self.views(result, left, right, predictor))

    def write(self, folder: Path, pair: str, result: DisparityResult, computed: _Computed) -> list[str]:
        """Writes the files; gives lines that say so.

        Raises:
            InputError: files that can't be written.
        """
        if computed is None:
            return []
        calibration, left, valid = computed
        lines = []
        for name in self.names(pair):
            # where it will be, which may be written elsewhere first
            place = Path(self.options.out) / name
            if place.stem.endswith("_cloud"):
                lines.append(f"{self._write_cloud(folder / name, calibration, result, left, valid)}; wrote {place}")
            else:
                said, lost = self._write_depth(folder / name, calibration, result, valid)
                lines.append(f"{said}; wrote {place}{lost}")
        return lines

    def calibration_of(self, result: DisparityResult, predictor: Predictor) -> Calibration:
        """That of the rectified pair, from the options or the predictor's rig.

        Raises:
            InputError: it is for images of another size, or one that a cloud needs more of.
        """
        rectification = predictor.rectification
        calibration = self.calibration if rectification is None else rectification.calibration
        assert calibration is not None
        calibration.check_size(*result.size)
        if self.options.cloud is not None:
            calibration.known_cy()
        return calibration

    def views(
        self, result: DisparityResult, left: ImageLike, right: ImageLike, predictor: Predictor
    ) -> tuple[npt.NDArray[Any] | None, npt.NDArray[np.bool_] | None]:
        """The rectified left view, for clouds, and the pixels that the right one sees too; None where nobody asked."""
        if not self.options.left_right and self.options.cloud is None:
            return None, None
        first, second = (view[0].permute(1, 2, 0).numpy() for view in predictor.rectified(left, right))
        if not self.options.left_right:
            return first, None
        return first, ~occluded(result.disparity, right_disparity(_match(predictor), first, second))

    def depth(self, calibration: Calibration, result: DisparityResult, valid: npt.NDArray[np.bool_] | None) -> Depth:
        """Metres, as the options say.

        Raises:
            InputError: options that do not fit the result.
        """
        options = self.options
        kept = result.trusted(min_confidence=options.min_confidence, valid=valid)
        disparity = np.where(kept, result.disparity, np.nan)
        if options.holes == "background":
            disparity = fill_background(disparity)
        return depth_from_disparity(disparity, calibration, max_depth=options.max_depth)

    def cloud(
        self,
        calibration: Calibration,
        result: DisparityResult,
        left: npt.NDArray[Any] | None,
        valid: npt.NDArray[np.bool_] | None,
    ) -> PointCloud:
        """The points, as the options say.

        Raises:
            InputError: options that do not fit the result.
        """
        options = self.options
        assert left is not None
        chosen = {name: value for name in ("axes", "holes") if (value := getattr(options, name)) is not None}
        return result.point_cloud(
            calibration,
            left,
            min_confidence=options.min_confidence,
            valid=valid,
            edge_filter=options.edge_filter,
            max_depth=options.max_depth,
            **chosen,
        )

    def _write_depth(
        self, path: Path, calibration: Calibration, result: DisparityResult, valid: npt.NDArray[np.bool_] | None
    ) -> tuple[str, str]:
        depth = self.depth(calibration, result, valid)
        beyond = write_depth(path, depth, overwrite=self.options.overwrite)
        known = depth[np.isfinite(depth)]
        reach = (
            f"{known.min():.2f} to {known.max():.2f} m, median {np.median(known):.2f} m" if known.size else "nothing"
        )
        lost = f"; {beyond} pixels beyond 65.535 m are 0 in it" if beyond else ""
        return f"depth of {100 * known.size / depth.size:.0f} % of the pixels: {reach}", lost

    def _write_cloud(
        self,
        path: Path,
        calibration: Calibration,
        result: DisparityResult,
        left: npt.NDArray[Any] | None,
        valid: npt.NDArray[np.bool_] | None,
    ) -> str:
        cloud = self.cloud(calibration, result, left, valid)
        cloud.write(path, overwrite=self.options.overwrite)
        return f"{len(cloud):,} points"


def _match(predictor: Predictor) -> Any:
    # the views that it gets are read already
    predictor = predictor.for_read_views()
    return lambda left, right: predictor.match(left, right).disparity


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
