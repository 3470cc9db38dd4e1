"""The loaders of a run."""

import os
from collections.abc import Mapping, Sequence

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset, Subset

from stereokit.data.datasets.dataset import StereoSample
from stereokit.errors import ConfigError
from stereokit.training.samples import Batch, ResumableLoader, TrainingSamples, to_batch, worker_processes

__all__ = ["StereoData", "usual_workers"]


class StereoData(LightningDataModule):
    """Gives each process its share of the training batches and of the validation pairs.

    Args:
        samples: to train on.
        batch: pairs a step, over all processes.
        steps: of the whole run.
        validation: sets to validate on, by name.
        workers: processes that read and augment, for each training process.

    Raises:
        ConfigError: the batch does not divide among the processes.
    """

    def __init__(
        self,
        samples: TrainingSamples,
        *,
        batch: int,
        steps: int,
        validation: Mapping[str, Sequence[StereoSample]],
        workers: int,
    ) -> None:
        super().__init__()
        self.samples = samples
        self.batch = batch
        self.steps = steps
        self.validation = validation
        self.workers = workers

    def train_dataloader(self) -> ResumableLoader:
        """Batches from the first that the run has not seen."""
        assert self.trainer is not None
        processes = self.trainer.world_size
        if self.batch % processes:
            raise ConfigError(f"a batch of {self.batch} does not divide among {processes} processes")
        return ResumableLoader(
            self.samples,
            batch=self.batch,
            # after the last batch Lightning takes the run for finished, and does not let it be made longer
            steps=self.steps + 1,
            rank=self.trainer.global_rank,
            processes=processes,
            workers=self.workers,
            pin_memory=torch.cuda.is_available(),
        )

    def val_dataloader(self) -> list[DataLoader[Batch]]:
        """One pair at a time, of whatever size."""
        assert self.trainer is not None
        rank, processes = self.trainer.global_rank, self.trainer.world_size
        return [
            DataLoader(
                # Lightning wants a pair for each process
                Subset(_ValidationSamples(pairs), range(rank, max(len(pairs), processes), processes)),
                batch_size=None,
                persistent_workers=self.workers > 0,
                **worker_processes(self.workers),
            )
            for pairs in self.validation.values()
        ]


class _ValidationSamples(Dataset[Batch]):
    """The pairs, and after them the first one without its ground truth, which counts nowhere."""

    def __init__(self, pairs: Sequence[StereoSample]) -> None:
        self.pairs = pairs

    def __getitem__(self, index: int) -> Batch:
        if index < len(self.pairs):
            return to_batch(self.pairs[index])
        batch = to_batch(self.pairs[0])
        return {**batch, "disparity": torch.full_like(batch["disparity"], torch.nan)}

    def __len__(self) -> int:
        return len(self.pairs)


def usual_workers(processes: int = 1) -> int:
    """Cores for each training process, less one for the process itself where the network runs on them too."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(16, cores // processes - 1))
