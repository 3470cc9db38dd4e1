"""Batch statistics of several GPUs."""

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from timm.layers.norm_act import convert_sync_batchnorm
from torch import nn

__all__ = ["SharedBatchStatistics"]


class SharedBatchStatistics(Callback):
    """Lets the batch norms of all processes normalise over the pairs of all, where they run on GPUs.

    In place of Lightning's `sync_batchnorm`, which loses the activations inside of timm's norms. torch has no such norm
    for CPUs.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Before the network is wrapped for several processes."""
        if trainer.world_size > 1 and trainer.strategy.root_device.type == "cuda":
            self.share(pl_module)

    @staticmethod
    def share(module: nn.Module) -> None:
        """Replaces the batch norms of a module; parameters and statistics stay the same tensors."""
        convert_sync_batchnorm(module)  # type: ignore[no-untyped-call]
