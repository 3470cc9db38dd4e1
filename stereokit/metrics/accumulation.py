"""The measures over a data set, image by image, without keeping the images."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.distributed
from torch import Tensor

from stereokit.errors import InputError
from stereokit.metrics.known import (
    absolute_error,
    checked_ceiling,
    checked_floor,
    checked_mask,
    checked_tau,
    is_outlier,
)

__all__ = ["StereoMetrics"]

REGIONS = ("all", "noc", "occ", "bg", "fg")


class StereoMetrics:
    """EPE, bad-tau and D1 over a data set, image by image, without keeping the images.

    Each measure exists twice: the mean over all pixels pooled (`epe`), in which an image with more ground
    truth weighs more, and the mean over images of each image's own mean (`epe_per_image`). Sums are float64
    and counts int64, on the CPU, whatever device the images are on.

    Args:
        taus: thresholds of bad-tau, in pixels.
        max_disparity: ceiling of the truth, exclusive, in pixels. None counts every known pixel, as KITTI
            does; 192 is customary for SceneFlow.
        min_disparity: floor of the truth in pixels, see `valid_pixels`.

    Raises:
        InputError: a threshold that is negative, not finite or given twice, or a floor and a ceiling that leave
            nothing.

    >>> metrics = StereoMetrics(taus=(1, 3), max_disparity=192)
    >>> truth = torch.tensor([[[10.0, 20.0, 0.0]], [[50.0, 300.0, 0.0]]])
    >>> metrics.update(truth + torch.tensor([[[2.0]], [[4.0]]]), truth)
    >>> results = metrics.compute()
    >>> {name: results[name] for name in ("bad_3", "bad_3_per_image", "epe_per_image", "pixels", "images")}
    {'bad_3': 33.333333333333336, 'bad_3_per_image': 50.0, 'epe_per_image': 3.0, 'pixels': 3, 'images': 2}

    An accumulator of one image gives that image's row, and merges into the data set's:

    >>> row = StereoMetrics(taus=(1, 3), max_disparity=192)
    >>> row.update(truth[:1], truth[:1])
    >>> row.compute()["epe"], metrics.merge(row).compute()["images"]
    (0.0, 3)
    """

    def __init__(
        self,
        *,
        taus: Sequence[float] = (1.0, 2.0, 3.0),
        max_disparity: float | None = None,
        min_disparity: float = 0,
    ) -> None:
        self.taus = tuple(checked_tau(tau) for tau in taus)
        self.min_disparity = checked_floor(min_disparity)
        self.max_disparity = None if max_disparity is None else checked_ceiling(max_disparity, self.min_disparity)
        self._measures = ("epe", *(f"bad_{tau:g}" for tau in self.taus), "d1")
        if len(set(self._measures)) < len(self._measures):
            raise InputError(f"taus are {self.taus}; expected thresholds that differ")
        shape = (len(REGIONS), len(self._measures))
        # Row: region. Column: measure. Pooled over pixels, then over images; `_seen` also counts images in
        # which no pixel of the region counts.
        self._sums = torch.zeros(shape, dtype=torch.float64)
        self._pixels = torch.zeros(shape, dtype=torch.int64)
        self._image_sums = torch.zeros(shape, dtype=torch.float64)
        self._images = torch.zeros(shape, dtype=torch.int64)
        self._seen = torch.zeros(len(REGIONS), dtype=torch.int64)

    @torch.no_grad()
    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        nonoccluded: Tensor | None = None,
        foreground: Tensor | None = None,
    ) -> None:
        """Adds a batch of images.

        Args:
            prediction: (B, H, W), in pixels, on any device.
            truth: (B, H, W), in pixels; 0 or non-finite is unknown.
            nonoccluded: (B, H, W), bool: pixels that the right image sees too. Makes `noc` and `occ` known.
                For KITTI, where `disp_noc` has a value.
            foreground: (B, H, W), bool: pixels of objects. Makes `bg` and `fg` known. For KITTI 2015, where
                the object map is above 0.

        Raises:
            InputError: tensors of another shape or type.
        """
        error, truth, valid = absolute_error(prediction, truth, None, self.max_disparity, self.min_disparity)
        if error.ndim != 3:
            raise InputError(f"prediction has shape {tuple(error.shape)}; expected a batch of maps, (B, H, W)")
        finite = torch.isfinite(error)
        bad = [error > tau for tau in self.taus] + [is_outlier(error, truth)]
        error = error.masked_fill(~finite, 0)

        regions = {"all": valid}
        if nonoccluded is not None:
            mask = checked_mask(nonoccluded, "nonoccluded", truth)
            regions |= {"noc": valid & mask, "occ": valid & ~mask}
        if foreground is not None:
            mask = checked_mask(foreground, "foreground", truth)
            regions |= {"bg": valid & ~mask, "fg": valid & mask}

        for name, region in regions.items():
            row = REGIONS.index(name)
            # (B, measures) each: of every image the sums and how many pixels they are over.
            error_sum = (error * region).sum((1, 2)).cpu().double()
            flags = torch.stack([region & finite, region, *(region & b for b in bad)], 1)
            counts = flags.sum((2, 3)).cpu()
            sums = torch.cat([error_sum[:, None], counts[:, 2:].double()], 1)
            pixels = torch.cat([counts[:, :1], counts[:, 1:2].expand(-1, len(bad))], 1)
            self._sums[row] += sums.sum(0)
            self._pixels[row] += pixels.sum(0)
            self._image_sums[row] += (sums / pixels.clamp(min=1)).sum(0)
            self._images[row] += (pixels > 0).sum(0)
            self._seen[row] += len(prediction)

    def compute(self) -> dict[str, float | int | None]:
        """All results so far, by name.

        Names are `<measure><region><mean>`:

        - measure: `epe` in pixels; `bad_<tau>` and `d1` in percent;
        - region: none for all counted pixels; `_noc` and `_occ`, non-occluded and occluded; `_bg` and `_fg`,
          background and foreground. Regions are absent where no update told them apart;
        - mean: none for the mean over pooled pixels; `_per_image` for the mean over images, of those images
          that have a pixel to average.

        Beside them, for each region: `pixels` that count; `images` with at least one of them;
        `images_without_pixels`; and `invalid_predictions`, how many of the pixels have a prediction that is
        not finite. These are in bad-tau and D1 as errors, and not in EPE. A mean over nothing is None.
        """
        results: dict[str, float | int | None] = {}
        for row, region in enumerate(REGIONS):
            if region != "all" and not self._seen[row]:
                continue
            suffix = "" if region == "all" else f"_{region}"
            for column, measure in enumerate(self._measures):
                unit = 1.0 if measure == "epe" else 100.0
                for mean, sums, numbers in (
                    ("", self._sums, self._pixels),
                    ("_per_image", self._image_sums, self._images),
                ):
                    number = int(numbers[row, column])
                    value = unit * float(sums[row, column]) / number if number else None
                    results[f"{measure}{suffix}{mean}"] = value
            pixels, images = int(self._pixels[row, -1]), int(self._images[row, -1])
            results[f"pixels{suffix}"] = pixels
            results[f"images{suffix}"] = images
            results[f"images_without_pixels{suffix}"] = int(self._seen[row]) - images
            results[f"invalid_predictions{suffix}"] = pixels - int(self._pixels[row, 0])
        return results

    def merge(self, other: "StereoMetrics") -> "StereoMetrics":
        """Adds what another accumulator has seen, as if its images had been given to this one.

        Returns:
            This accumulator.

        Raises:
            InputError: the other one counts by other rules.
        """
        for name in ("taus", "max_disparity", "min_disparity"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if mine != theirs:
                raise InputError(f"metrics with {name}={mine} and {name}={theirs} can't be merged; use one for both")
        for name, tensor in self._tensors().items():
            tensor += other._tensors()[name]
        return self

    def merged_over_processes(self, group: Any = None) -> "StereoMetrics":
        """The sum over all processes of a `torch.distributed` group; alone, a copy.

        Every process has to call it, and each gets the same. A sampler that repeats images so that the
        processes have equally many makes them count twice.

        Args:
            group: a process group, or None for all processes.
        """
        states = [self.state_dict()]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            states = states * torch.distributed.get_world_size(group)
            torch.distributed.all_gather_object(states, self.state_dict(), group=group)
        merged = StereoMetrics(**self.settings())
        for state in states:
            merged.merge(StereoMetrics.from_state_dict(state))
        return merged

    def settings(self) -> dict[str, Any]:
        """The rules that it counts by, in plain JSON: the arguments of another accumulator of the kind."""
        return {"taus": list(self.taus), "max_disparity": self.max_disparity, "min_disparity": self.min_disparity}

    def state_dict(self) -> dict[str, Any]:
        """Everything seen so far, in numbers and lists that JSON keeps exactly.

        >>> metrics = StereoMetrics(taus=[2])
        >>> StereoMetrics.from_state_dict(metrics.state_dict()).compute() == metrics.compute()
        True
        """
        return {**self.settings(), **{name: tensor.tolist() for name, tensor in self._tensors().items()}}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> "StereoMetrics":
        """The accumulator that `state_dict` described.

        Raises:
            InputError: names missing, unknown or of another size.
        """
        expected = list(cls().state_dict())
        if set(state) != set(expected):
            raise InputError(
                f"the metrics' state has the entries {', '.join(map(str, state)) or 'none'}; "
                f"expected {', '.join(expected)}"
            )
        try:
            metrics = cls(**{name: state[name] for name in cls().settings()})
            for name, tensor in metrics._tensors().items():
                values = torch.tensor(state[name], dtype=tensor.dtype)
                if values.shape != tensor.shape:
                    raise InputError(f"{name} has shape {tuple(values.shape)}; expected {tuple(tensor.shape)}")
                tensor.copy_(values)
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise InputError(f"the metrics' state is damaged: {error}") from error
        return metrics

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "sums": self._sums,
            "pixels": self._pixels,
            "image_sums": self._image_sums,
            "images": self._images,
            "seen": self._seen,
        }
