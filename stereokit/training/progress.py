"""The progress bar of a run."""

from typing import Any, cast

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm

from stereokit.training.module import StereoTraining

__all__ = ["ProgressBar"]


class ProgressBar(TQDMProgressBar):
    """Shows steps of the whole run; where minutes end it, it promises no number of steps and shows minutes."""

    @property
    def total_train_batches(self) -> int | float:
        """Of the whole run."""
        return cast(StereoTraining, self.trainer.lightning_module).steps

    def init_train_tqdm(self) -> Tqdm:
        """The bar, at the step that the run is at."""
        bar = super().init_train_tqdm()
        if cast(StereoTraining, self.trainer.lightning_module).minutes is not None:
            bar.bar_format = "{desc}{n_fmt} [{elapsed}, {rate_noinv_fmt}{postfix}]"
        # Lightning sets these where an epoch starts; a run that is resumed is within one
        bar.total, bar.initial = self.total_train_batches, self.trainer.global_step
        return bar

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """What stands behind the bar."""
        training = cast(StereoTraining, pl_module)
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        if training.minutes is None:
            return metrics
        return {"minutes": f"{training.seconds / 60:.1f} of {training.minutes:g}", **metrics}
