"""Data sets of stereo pairs, by kind: each finds its own layout on disk and gives `StereoSample`s."""

from stereokit.data.datasets import (  # noqa: F401  (registers the kinds)
    booster,
    crestereo,
    drivingstereo,
    eth3d,
    folder,
    instereo2k,
    kitti,
    middlebury,
    sceneflow,
    sintel,
    spring,
    tartanair,
    virtual_kitti,
)
from stereokit.data.datasets.checking import DatasetReport, check_dataset, format_report
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry, StereoSample
from stereokit.data.datasets.opening import open_dataset

__all__ = [
    "DATASETS",
    "DatasetReport",
    "Source",
    "StereoDataset",
    "StereoEntry",
    "StereoSample",
    "check_dataset",
    "format_report",
    "open_dataset",
]
