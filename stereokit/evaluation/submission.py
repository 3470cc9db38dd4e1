"""Disparity in the layout that KITTI's test server takes."""

import os
from collections.abc import Sequence
from pathlib import Path

from stereokit.data.datasets.dataset import StereoDataset, StereoSample
from stereokit.data.disparity_arrays import Disparity
from stereokit.data.disparity_png import write_kitti_png
from stereokit.errors import InputError
from stereokit.evaluation.results import PairResult
from stereokit.files import check_free, make_folder

__all__ = ["KittiSubmission"]

FOLDERS = {"kitti2012": ".", "kitti2015": "disp_0"}


class KittiSubmission:
    """Writes each prediction where KITTI's server looks for it: an observer of `evaluate`.

    The maps are 16-bit PNGs of the images' own size, `NNNNNN_10.png`: in the root of the archive for KITTI 2012, in
    `disp_0` for KITTI 2015. A pixel without a finite prediction is stored as 0; the server fills those from the
    background. Zip the content of the folder to submit it.

    Args:
        folder: is made if need be.
        dataset: KITTI 2012 or 2015.
        overwrite: replace existing files.

    Raises:
        InputError: another kind of data set, or a file that exists already.

    Source: the readmes of KITTI's stereo development kits, 2012 and 2015.
    """

    def __init__(self, folder: str | os.PathLike[str], dataset: StereoDataset, *, overwrite: bool = False) -> None:
        if dataset.kind not in FOLDERS:
            raise InputError(f"a submission is for {' or '.join(FOLDERS)}, got {dataset.kind}")
        self.folder = Path(folder) / FOLDERS[dataset.kind]
        self.overwrite = overwrite
        check_free(self.paths([entry.name for entry in dataset.entries]), overwrite=overwrite)

    def paths(self, names: Sequence[str]) -> list[Path]:
        """The files of the pairs of these names."""
        return [self.folder / f"{name}.png" for name in names]

    def __call__(self, dataset: str, sample: StereoSample, prediction: Disparity, result: PairResult) -> None:
        """Writes one prediction.

        Raises:
            InputError: a disparity that KITTI's encoding can't hold, below 0 or above 255.996.
        """
        make_folder(self.folder)
        write_kitti_png(self.paths([sample.name])[0], prediction, overwrite=self.overwrite)
