"""An evaluation as a page to look at: where a matcher fails, and how."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stereokit.data.datasets.dataset import StereoSample
from stereokit.data.disparity_arrays import Disparity
from stereokit.data.images import to_uint8
from stereokit.errors import ConfigError
from stereokit.evaluation.report_page import Card, evaluation_page
from stereokit.evaluation.results import Evaluation, PairResult
from stereokit.files import atomic_path, check_free, make_folder
from stereokit.metrics import valid_pixels
from stereokit.pictures import colorize, error_picture, robust_range
from stereokit.pictures.page import MAX_WIDTH, Figure, exact, photograph

__all__ = ["Report", "worst_first"]


def worst_first(pair: PairResult) -> tuple[float, float]:
    """A key that sorts pairs by D1, then by end-point error, the worst first; those without numbers come last."""
    metrics = pair.metrics or {}
    d1, epe = metrics.get("d1"), metrics.get("epe")
    return (1.0 if d1 is None else -d1, 0.0 if epe is None else -epe)


@dataclass(frozen=True)
class _Shown:
    result: PairResult
    figures: tuple[Figure, ...]


class Report:
    """Collects pictures as an observer of `evaluate`, and writes them with the numbers as one HTML file.

    The page holds its pictures and its style and loads nothing: it opens from disk, and its content-security policy
    forbids scripts and the network. Rows and pictures are sorted by D1, the worst first.

    Args:
        folder: of the page, `index.html`; is made if need be.
        most: how many pairs of each data set are shown in pictures, the worst ones; all have a row.
        overwrite: replace an existing page.
        min_disparity: floor of the ground truth that is shown, in pixels, as it was given to `evaluate`.

    Raises:
        InputError: there is a page already.

    >>> import tempfile
    >>> report = Report(tempfile.mkdtemp())
    >>> report.path.name
    'index.html'
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        most: int = 100,
        overwrite: bool = False,
        min_disparity: float = 0,
    ) -> None:
        if most < 0:
            raise ConfigError(f"most is {most}; expected 0 or more pairs to show")
        self.path = Path(folder) / "index.html"
        self.most = most
        self.overwrite = overwrite
        self.min_disparity = min_disparity
        self._shown: dict[str, list[_Shown]] = {}
        check_free([self.path], overwrite=overwrite)

    def __call__(self, dataset: str, sample: StereoSample, prediction: Disparity, result: PairResult) -> None:
        """Draws one pair, if it is among the worst so far."""
        shown = self._shown.setdefault(dataset, [])
        if len(shown) == self.most and (not shown or worst_first(result) >= worst_first(shown[-1].result)):
            return
        shown.append(_Shown(result, _figures(sample, prediction, self.min_disparity)))
        shown.sort(key=lambda one: worst_first(one.result))
        del shown[self.most :]

    def save(self, evaluation: Evaluation) -> Path:
        """Writes the page.

        Args:
            evaluation: that this report has observed.

        Returns:
            Its path.
        """
        cards = {name: [Card(one.result, one.figures) for one in shown] for name, shown in self._shown.items()}
        rows = {result.name: sorted(result.pairs, key=worst_first) for result in evaluation.datasets}
        make_folder(self.path.parent)
        with atomic_path(self.path, overwrite=self.overwrite) as temporary:
            # names of files may be any bytes
            temporary.write_text(evaluation_page(evaluation, rows, cards), encoding="utf-8", errors="backslashreplace")
        return self.path


def _figures(sample: StereoSample, prediction: Disparity, min_disparity: float) -> tuple[Figure, ...]:
    """Left image, ground truth, prediction and error; truth and prediction share their colours' range."""
    truth = sample.disparity
    known = None
    if truth is not None:
        known = np.where(valid_pixels(torch.from_numpy(truth), min_disparity=min_disparity).numpy(), truth, np.nan)
    has_truth = known is not None and bool(np.isfinite(known).any())
    value_range = robust_range(known if known is not None and has_truth else prediction)
    scale = f"{value_range[0]:.0f} to {value_range[1]:.0f} px"
    figures = [Figure("Left image", "", photograph(to_uint8(sample.left)))]
    if known is not None and has_truth:
        figures.append(Figure("Ground truth", scale, exact(colorize(known, value_range=value_range))))
    figures.append(Figure("Prediction", scale, photograph(colorize(prediction, value_range=value_range))))
    if known is not None and has_truth:
        # What is drawn smaller has to spread further to be seen.
        dilate = max(1, round(prediction.shape[1] / MAX_WIDTH))
        occluded = None if sample.nonocc is None else ~sample.nonocc
        errors = error_picture(prediction, known, occluded=occluded, dilate=dilate, min_disparity=min_disparity)
        note = "darker where occluded" if occluded is not None else ""
        figures.append(Figure("Error", note, exact(errors)))
    return tuple(figures)
