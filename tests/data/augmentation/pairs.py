"""Pairs whose truth is known by construction, and a measure of how true x_right = x_left - d is."""

from dataclasses import replace

import numpy as np

from stereokit.calibration.rectified import Calibration
from stereokit.data.datasets import StereoSample

CAMERA = Calibration(fx=100.0, baseline=0.5, cx0=20.0, cx1=23.0, width=48, height=32)


def layered(seed=0, height=32, width=48, floating=False, depths=(3, 6, 9), both=False):
    """Boards at whole-numbered disparities before a wall, each with its own texture; exact."""
    rng = np.random.default_rng(seed)
    boards = [(0, height, -width, 2 * width, 1)]
    for disparity in depths:
        top, left = rng.integers(0, height - 8), rng.integers(0, width - 10)
        right = left + rng.integers(6, 16)
        boards.append((top, top + rng.integers(4, 12), left, min(right, width), disparity))
    left = np.zeros((height, width, 3), np.uint8)
    right = np.zeros((height, width, 3), np.uint8)
    disparity, seen_right = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    objects = np.zeros((height, width), np.uint8)
    for number, (top, bottom, first, last, d) in enumerate(boards):
        texture = rng.integers(0, 256, (height, last - first, 3), np.uint8)
        for view, shift in ((left, 0), (right, d)):
            begin, end = max(first - shift, 0), min(last - shift, width)
            if begin >= end:
                continue
            view[top:bottom, begin:end] = texture[top:bottom, begin + shift - first : end + shift - first]
            if shift == 0:
                disparity[top:bottom, begin:end] = d
                objects[top:bottom, begin:end] = number
            else:
                seen_right[top:bottom, begin:end] = d
    match = np.arange(width) - disparity.astype(int)
    nonocc = (match >= 0) & (np.take_along_axis(seen_right, np.maximum(match, 0), 1) == disparity)
    match = np.arange(width) + seen_right.astype(int)
    right_nonocc = match < width
    right_nonocc &= np.take_along_axis(disparity, np.minimum(match, width - 1), 1) == seen_right
    if floating:
        left, right = (view.astype(np.float32) / 255 for view in (left, right))
    pair = StereoSample("layered", left, right, disparity, nonocc, objects, replace(CAMERA, width=width, height=height))
    return replace(pair, right_disparity=seen_right, right_nonocc=right_nonocc) if both else pair


def slanted(offset=4.0, slope=0.05, height=32, width=48):
    """A slanted plane with a smooth texture, so that both views can be read between the pixels."""
    x = np.arange(width, dtype=np.float64)
    disparity = np.tile(offset + slope * x, (height, 1)).astype(np.float32)

    def texture(columns):
        rows = np.arange(height)[:, None]
        waves = [np.sin(columns / period + rows / 9 + period) for period in (2.7, 4.1, 5.3)]
        return (0.5 + 0.45 * np.stack(waves, axis=-1)).astype(np.float32)

    return StereoSample("slanted", texture(x), texture((x + offset) / (1 - slope)), disparity, None, None, CAMERA)


def right_errors(sample):
    """|right(x) - left(x + d)|, which is `errors` seen in a mirror."""
    return errors(
        StereoSample(
            "mirrored",
            sample.right[:, ::-1],
            sample.left[:, ::-1],
            sample.right_disparity[:, ::-1],
            None if sample.right_nonocc is None else sample.right_nonocc[:, ::-1],
        )
    )


def errors(sample, disparity=None):
    """|left(x) - right(x - d)| at the pixels whose match lies in the image and is not known to be hidden."""
    disparity = sample.disparity if disparity is None else disparity
    match = np.arange(disparity.shape[1]) - disparity
    valid = np.isfinite(match) & (match >= 0) & (match <= disparity.shape[1] - 1)
    if sample.nonocc is not None:
        valid &= sample.nonocc
    assert valid.any()
    rows, columns = np.nonzero(valid)
    exact = match[rows, columns]
    low = np.floor(exact).astype(int)
    high = np.minimum(low + 1, disparity.shape[1] - 1)
    part = (exact - low)[:, None]
    right = sample.right.astype(np.float64)
    seen = right[rows, low] * (1 - part) + right[rows, high] * part
    return np.abs(sample.left[rows, columns] - seen)
