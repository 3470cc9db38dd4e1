"""Pictures of validation pairs while a network learns."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from stereokit.data.images import to_uint8, write_image
from stereokit.data.inputs import as_array
from stereokit.files import make_folder
from stereokit.pictures import captioned, colorize, error_picture, robust_range
from stereokit.training.samples import Batch

__all__ = ["ValidationPictures", "picture"]


def picture(left: Tensor, truth: Tensor, disparity: Tensor) -> npt.NDArray[np.uint8]:
    """Left image over the prediction, ground truth over the error, with captions, RGB.

    Args:
        left: (3, H, W), uint8, or float in [0, 1].
        truth: (H, W), NaN where unknown.
        disparity: (H, W).

    >>> import torch
    >>> picture(torch.zeros(3, 32, 48), torch.ones(32, 48), torch.ones(32, 48)).shape
    (64, 96, 3)
    """
    image = to_uint8(as_array(left.permute(1, 2, 0)))
    known, estimate = as_array(truth), as_array(disparity)
    span = robust_range(known if np.isfinite(known).any() else estimate)
    tiles = [
        {"left image": image, "ground truth": colorize(known, value_range=span)},
        {"prediction": colorize(estimate, value_range=span), "error": error_picture(estimate, known)},
    ]
    return np.concatenate(
        [np.concatenate([captioned(tile, text) for text, tile in row.items()], axis=1) for row in tiles]
    )


class ValidationPictures(Callback):
    """Writes pictures of the first pairs of each validation set, to a folder and to TensorBoard.

    Args:
        folder: for SET/PAIR_STEP.png.
        names: of the validation sets.
        count: pairs of each set.
    """

    def __init__(self, folder: Path, names: Sequence[str], count: int = 4) -> None:
        self.folder = folder
        self.names = names
        self.count = count

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """A picture of the pair."""
        if batch_idx >= self.count or not trainer.is_global_zero or trainer.sanity_checking:
            return
        shown = picture(batch["left"][0], batch["disparity"][0], outputs[0])
        name = self.names[dataloader_idx]
        folder = self.folder / name.replace("/", "_")
        make_folder(folder)
        write_image(folder / f"{batch_idx}_{trainer.global_step:07d}.png", shown, overwrite=True)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(f"{name}/{batch_idx}", shown, trainer.global_step, dataformats="HWC")
