"""Training samples by number: what is drawn depends on the seed and the number alone."""

import os
from collections.abc import Iterator, Sequence
from multiprocessing import get_all_start_methods, parent_process
from threading import Thread
from typing import Any, Protocol, TypedDict

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from stereokit.data.augmentation import Augmentation
from stereokit.data.datasets.dataset import StereoSample
from stereokit.data.inputs import to_pair
from stereokit.errors import InputError
from stereokit.layers.casting import as_float

__all__ = ["Batch", "ResumableLoader", "TrainingSamples", "to_batch", "worker_processes"]


class Batch(TypedDict):
    """Pairs of one size with the ground truth of the left view."""

    left: Tensor
    """(B, 3, H, W), uint8, or float in [0, 1]."""
    right: Tensor
    """The same."""
    disparity: Tensor
    """(B, H, W) float32, pixels, NaN where unknown."""


class _Pairs(Protocol):
    """What holds pairs: a `StereoDataset`, `SyntheticScenes`, or any sequence of samples."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> StereoSample: ...


class TrainingSamples(Dataset[Batch]):
    """An endless run of augmented samples: every pair of the data sets once an epoch, in a new order each time.

    Sample number i is the same in whatever process and however often it is drawn: a run that goes on after a break,
    or with more workers, sees what an unbroken one sees.

    Args:
        datasets: concatenated.
        augmentation: of each pair; its crop makes the sizes equal.
        seed: of the orders and of the augmentation.
        shuffle: False takes the pairs as they come.

    Raises:
        InputError: there is no pair.

    >>> from stereokit.data.synthetic import SyntheticScenes
    >>> scenes = SyntheticScenes(size=(32, 64), max_disparity=16, count=3)
    >>> samples = TrainingSamples([scenes], Augmentation(crop_height=32, crop_width=48), seed=0)
    >>> samples[7]["left"].shape, sorted(samples.place(number)[1] for number in range(3, 6))
    (torch.Size([1, 3, 32, 48]), [0, 1, 2])
    """

    def __init__(
        self, datasets: Sequence[_Pairs], augmentation: Augmentation, *, seed: int, shuffle: bool = True
    ) -> None:
        self.datasets = list(datasets)
        self.lengths = [len(dataset) for dataset in datasets]
        if not sum(self.lengths):
            raise InputError("there is no pair to train on")
        self.augmentation = augmentation
        self.seed = seed
        self.shuffle = shuffle
        self._order: tuple[int, np.ndarray[Any, Any]] | None = None

    @property
    def pairs(self) -> int:
        """How many there are in an epoch."""
        return sum(self.lengths)

    def place(self, number: int) -> tuple[int, int]:
        """The data set that sample `number` is taken from, and its place there."""
        epoch, index = divmod(number, self.pairs)
        if self.shuffle:
            if self._order is None or self._order[0] != epoch:
                self._order = epoch, np.random.default_rng([self.seed, 0, epoch]).permutation(self.pairs)
            index = int(self._order[1][index])
        for which, length in enumerate(self.lengths):
            if index < length:
                return which, index
            index -= length
        raise IndexError(number)

    def __getitem__(self, number: int) -> Batch:
        which, index = self.place(number)
        sample = self.datasets[which][index]
        if sample.disparity is None:
            raise InputError(f"pair {sample.name!r} has no ground truth to train on")
        return to_batch(self.augmentation(sample, np.random.default_rng([self.seed, 1, number])))


def to_batch(sample: StereoSample) -> Batch:
    """A batch of one; without ground truth its disparity is unknown everywhere."""
    left, right = to_pair(sample.left, sample.right)
    unknown = np.full(sample.left.shape[:2], np.nan, np.float32)
    disparity = unknown if sample.disparity is None else sample.disparity
    return Batch(left=left, right=right, disparity=torch.from_numpy(np.ascontiguousarray(disparity))[None])


class ResumableLoader(DataLoader[Batch]):
    """Batches of `TrainingSamples`, step by step; with several processes each gets its share of every step's batch.

    It counts the batches that it gave and goes on from there after `load_state_dict`.

    Args:
        samples: to draw from.
        batch: pairs a step, over all processes.
        steps: of the whole run.
        rank, processes: this process, and how many there are.
        workers: processes that read and augment.

    >>> from stereokit.data.synthetic import SyntheticScenes
    >>> scenes = SyntheticScenes(size=(32, 48), max_disparity=16, count=8)
    >>> samples = TrainingSamples([scenes], Augmentation(crop_height=32, crop_width=48), seed=0)
    >>> loader = ResumableLoader(samples, batch=2, steps=4)
    >>> len(loader), next(iter(loader))["right"].shape
    (4, torch.Size([2, 3, 32, 48]))
    """

    def __init__(
        self,
        samples: TrainingSamples,
        *,
        batch: int,
        steps: int,
        rank: int = 0,
        processes: int = 1,
        workers: int = 0,
        pin_memory: bool = False,
    ) -> None:
        self.numbers = _Numbers(batch, steps, rank, processes)
        super().__init__(
            samples,
            batch_sampler=self.numbers,
            collate_fn=_collate,
            pin_memory=pin_memory,
            prefetch_factor=4 if workers else None,
            **worker_processes(workers),
        )

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        for batch in super().__iter__():
            self.numbers.given += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        """How many batches were given."""
        return {"given": self.numbers.given}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Goes on after so many batches."""
        self.numbers.given = state["given"]


class _Numbers(Sampler[list[int]]):
    """The numbers of the samples of each batch, from the first one that was not given yet."""

    def __init__(self, batch: int, steps: int, rank: int, processes: int) -> None:
        self.batch, self.steps = batch, steps
        self.rank, self.share = rank, batch // processes
        self.given = 0

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.given, self.steps):
            first = step * self.batch + self.rank * self.share
            yield list(range(first, first + self.share))


def _collate(samples: list[Batch]) -> Batch:
    alike = len({sample["left"].dtype for sample in samples}) == 1
    left, right = (
        torch.cat([sample[view] if alike else as_float(sample[view]) for sample in samples])
        for view in ("left", "right")
    )
    return Batch(left=left, right=right, disparity=torch.cat([sample["disparity"] for sample in samples]))


def worker_processes(workers: int) -> dict[str, Any]:
    """Arguments of `DataLoader` for so many processes that read and augment."""
    if not workers:
        return {"num_workers": 0}
    # a forked copy of OpenCV's thread pool hangs
    start = "forkserver" if "forkserver" in get_all_start_methods() else "spawn"
    return {"num_workers": workers, "multiprocessing_context": start, "worker_init_fn": _start_worker}


def _start_worker(_worker: int) -> None:
    # workers share the cores with each other and with the network
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    Thread(target=_end_with_trainer, daemon=True).start()


def _end_with_trainer() -> None:
    # the process that PyTorch's workers watch is the fork server here, which itself waits for the workers' end
    trainer = parent_process()
    if trainer is not None:
        trainer.join()
        os._exit(1)
