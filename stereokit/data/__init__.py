"""Stereo data: image, disparity and calibration files, data sets, augmentation."""

from stereokit.calibration import Calibration, read_calibration
from stereokit.data.datasets import (
    DATASETS,
    StereoDataset,
    StereoSample,
    check_dataset,
    format_report,
    open_dataset,
)
from stereokit.data.disparity_files import read_disparity, write_disparity
from stereokit.data.disparity_png import read_kitti_png, write_kitti_png
from stereokit.data.images import read_image, write_image
from stereokit.data.pfm import read_pfm, write_pfm
from stereokit.files import atomic_path

__all__ = [
    "DATASETS",
    "Calibration",
    "StereoDataset",
    "StereoSample",
    "atomic_path",
    "check_dataset",
    "format_report",
    "open_dataset",
    "read_calibration",
    "read_disparity",
    "read_image",
    "read_kitti_png",
    "read_pfm",
    "write_disparity",
    "write_image",
    "write_kitti_png",
    "write_pfm",
]
