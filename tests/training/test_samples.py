import subprocess
import sys
from collections import Counter
from itertools import chain

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stereokit.data.augmentation import Augmentation
from stereokit.data.datasets.dataset import StereoSample
from stereokit.errors import InputError
from stereokit.training import ResumableLoader, TrainingSamples
from stereokit.training.samples import to_batch

CROP = Augmentation(crop_height=4, crop_width=6)


def pairs(count, first=0, *, truth=True):
    """Tiny pairs of which each has its own grey value."""
    for number in range(first, first + count):
        image = np.full((8, 12, 3), number, np.uint8)
        yield StereoSample(str(number), image, image, np.ones((8, 12), np.float32) if truth else None)


def grey(batch):
    return [int(image[0, 0, 0]) for image in batch["left"]]


@given(st.lists(st.integers(0, 5), min_size=1, max_size=3).filter(sum), st.integers(0, 3), st.integers(0, 5))
def test_an_epoch_holds_every_pair_once(lengths, epoch, seed):
    samples = TrainingSamples([list(pairs(length)) for length in lengths], CROP, seed=seed)
    numbers = range(epoch * samples.pairs, (epoch + 1) * samples.pairs)
    everything = {(which, index) for which, length in enumerate(lengths) for index in range(length)}
    assert Counter(samples.place(number) for number in numbers) == Counter(everything)


def test_epochs_have_different_orders_and_seeds_too():
    def order(seed, epoch):
        samples = TrainingSamples([list(pairs(40))], CROP, seed=seed)
        return [samples.place(number) for number in range(epoch * 40, (epoch + 1) * 40)]

    assert order(0, 0) == order(0, 0)
    assert order(0, 0) != order(0, 1)
    assert order(0, 0) != order(1, 0)


def test_without_shuffling_pairs_come_in_order():
    samples = TrainingSamples([list(pairs(3)), list(pairs(2, 3))], CROP, seed=0, shuffle=False)
    assert [grey(samples[number]) for number in range(7)] == [[0], [1], [2], [3], [4], [0], [1]]


def test_pairs_of_8_and_16_bits_share_a_batch():
    image = np.full((8, 12, 3), 204, np.uint8)
    deep = np.full((8, 12, 3), 204 * 257, np.uint16)
    data = [StereoSample("a", x, x, np.ones((8, 12), np.float32)) for x in (image, deep)]
    batch = next(iter(ResumableLoader(TrainingSamples([data], CROP, seed=0), batch=2, steps=1)))
    for view in ("left", "right"):
        torch.testing.assert_close(batch[view], torch.full((2, 3, 4, 6), 0.8))


def test_a_sample_hangs_on_its_number_alone():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    data = [StereoSample("a", image, image, np.ones((40, 60), np.float32))]
    augmentation = Augmentation(crop_height=8, crop_width=8, colour=1.0)
    first, second = (TrainingSamples([data], augmentation, seed=3) for _ in range(2))
    late = first[5]["left"]
    for number in range(5):
        second[number]
    assert torch.equal(second[5]["left"], late)
    assert not torch.equal(second[6]["left"], late)


@given(st.integers(1, 4), st.integers(1, 3), st.integers(0, 6))
def test_the_processes_shares_make_up_the_joint_batch(share, processes, resumed_at):
    samples = TrainingSamples([list(pairs(30))], CROP, seed=0)

    def batches(rank, of):
        loader = ResumableLoader(samples, batch=share * processes, steps=6, rank=rank, processes=of)
        loader.load_state_dict({"given": resumed_at})
        return [grey(batch) for batch in loader]

    joint = batches(0, 1)
    assert len(joint) == 6 - resumed_at
    shares = [batches(rank, processes) for rank in range(processes)]
    assert [list(chain(*parts)) for parts in zip(*shares, strict=True)] == joint


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.slow
def test_a_resumed_loader_goes_on_behind_what_it_gave(workers):
    samples = TrainingSamples([list(pairs(30))], CROP, seed=0)
    whole = [grey(batch) for batch in ResumableLoader(samples, batch=4, steps=6, workers=workers)]
    loader = ResumableLoader(samples, batch=4, steps=6, workers=workers)
    start = iter(loader)
    begun = [grey(next(start)) for _ in range(2)]
    other = ResumableLoader(samples, batch=4, steps=6, workers=workers)
    other.load_state_dict(loader.state_dict())
    assert begun + [grey(batch) for batch in other] == whole
    assert len(other) == 6


def test_bad_data():
    with pytest.raises(InputError, match="no pair to train on"):
        TrainingSamples([[]], CROP, seed=0)
    with pytest.raises(InputError, match="pair '0' has no ground truth"):
        TrainingSamples([list(pairs(1, truth=False))], CROP, seed=0)[0]


def test_a_pair_without_truth_is_a_batch_of_unknowns():
    batch = to_batch(next(pairs(1, truth=False)))
    assert batch["left"].shape == (1, 3, 8, 12)
    assert batch["disparity"].isnan().all()


LOADING = """
import time
from stereokit.data.augmentation import Augmentation
from stereokit.data.synthetic import SyntheticScenes
from stereokit.training import ResumableLoader, TrainingSamples

scenes = SyntheticScenes(size=(32, 48), max_disparity=16, count=8)
samples = TrainingSamples([scenes], Augmentation(crop_height=32, crop_width=48), seed=0)
batches = iter(ResumableLoader(samples, batch=2, steps=100, workers=2))
next(batches)
print("loading", flush=True)
time.sleep(600)
"""


@pytest.mark.slow
def test_workers_end_with_a_training_that_is_killed():
    with subprocess.Popen([sys.executable, "-c", LOADING], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "loading\n"
        process.kill()
        # the workers hold the pipe open for as long as they live
        assert process.communicate(timeout=60)[0] == ""
