"""Batch statistics of several GPUs."""

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from timm.layers.norm_act import convert_sync_batchnorm
from torch import nn

__all__ = ["SharedBatchStatistics"]


class SharedBatchStatistics(Callback):
    """Lets the batch norms of all processes normalise over the pairs of all, where they run on GPUs.

    In place of Lightning's `sync_batchnorm`, which loses the activations inside of timm's norms. torch has no such norm
    for CPUs. After the run the network has its own norms again.
    """

    def __init__(self) -> None:
        self._own: dict[str, nn.Module] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Before the network is wrapped for several processes."""
        if trainer.world_size > 1 and trainer.strategy.root_device.type == "cuda":
            self.share(pl_module)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Behind the run."""
        self.separate(pl_module)

    def share(self, module: nn.Module) -> None:
        """Replaces the batch norms of a module; parameters and statistics stay the same tensors."""
        self._own = {
            name: norm
            for name, norm in module.named_modules(remove_duplicate=False)
            if isinstance(norm, nn.modules.batchnorm._BatchNorm)
        }
        convert_sync_batchnorm(module)  # type: ignore[no-untyped-call]

    def separate(self, module: nn.Module) -> None:
        """The reverse, with what was learnt meanwhile."""
        for name, norm in self._own.items():
            shared = module.get_submodule(name)
            norm._parameters, norm._buffers = shared._parameters, shared._buffers
            norm.train(shared.training)
            module.set_submodule(name, norm)
        self._own = {}
