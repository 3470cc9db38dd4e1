import math
from dataclasses import replace

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, WeightAveraging
from torch import nn

from stereokit.builder import build_model
from stereokit.losses import masked_cross_entropy, stereo_loss
from stereokit.training import Averaging, StereoTraining, TrainingError
from stereokit.training.averaging import AveragedWeights
from stereokit.training.module import MOST_BROKEN_STEPS
from stereokit.training.recipe import Loss
from stereokit.training.schedule import Schedule
from tests.training.tiny import TINY


def batch(pairs=2, known=1.0):
    generator = torch.Generator().manual_seed(pairs)
    left, right = (torch.rand(pairs, 3, 32, 64, generator=generator) for _ in range(2))
    truth = torch.rand(pairs, 32, 64, generator=generator) * 20 + 1
    truth[torch.rand(truth.shape, generator=generator) > known] = torch.nan
    return {"left": left, "right": right, "disparity": truth}


def fit(training: LightningModule, batches, *callbacks: Callback, validation=None, **options) -> Trainer:
    trainer = Trainer(
        accelerator="cpu",
        max_steps=len(batches),
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=list(callbacks),
        **options,
    )
    trainer.fit(training, loader(batches), None if validation is None else loader(validation))
    return trainer


def loader(batches):
    return torch.utils.data.DataLoader(batches, batch_size=None)


def tiny_training(steps=3, **changes) -> StereoTraining:
    return StereoTraining(build_model("coex", max_disparity=32), replace(TINY, **changes), steps=steps)


class Rates(Callback):
    def __init__(self):
        self.rates = []

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        self.rates += [group["lr"] for group in optimizer.param_groups]


def test_the_rate_follows_the_schedule_over_the_steps():
    training = tiny_training(4, schedule=Schedule(batch=2, steps=4, milestones=(0.5,), factor=0.1))
    rates = Rates()
    fit(training, [batch()] * 4, rates)
    assert rates.rates == pytest.approx([1e-3, 1e-3, 1e-4, 1e-4])
    assert training.pairs_seen == 8


class Slow(Callback):
    """Steps and validation pairs take as long as they are said to."""

    def __init__(self, monkeypatch, step, validation_pair):
        self.now, self.step, self.validation_pair = 0.0, step, validation_pair
        monkeypatch.setattr("stereokit.training.module.time.monotonic", lambda: self.now)

    def on_train_batch_end(self, *_):
        self.now += self.step

    def on_validation_batch_end(self, *_):
        self.now += self.validation_pair


def test_a_run_in_minutes_ends_when_they_are_over(monkeypatch):
    training = tiny_training(100, schedule=Schedule(batch=2, steps=100, milestones=(0.5,), factor=0.1))
    training.minutes = 0.5
    rates, clock = Rates(), Slow(monkeypatch, 6, 0)
    trainer = fit(training, [batch()] * 20, rates, clock)
    assert trainer.global_step == len(rates.rates) == 5
    assert rates.rates == pytest.approx([1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
    assert clock.now == 30


@pytest.mark.parametrize(
    ("validation_pair", "interval", "steps", "seconds"),
    [
        (1.5, 100, 18, 60),  # as long as a pair in training
        (1, 6, 16, 60),  # measured in the first two
        (100, 100, 18, 454),  # not to be foreseen
    ],
)
def test_minutes_keep_time_for_the_one_last_validation(monkeypatch, validation_pair, interval, steps, seconds):
    training = StereoTraining(build_model("coex", max_disparity=32), TINY, steps=100, minutes=1, validation=("a",))
    clock = Slow(monkeypatch, 3, validation_pair)
    often = {"val_check_interval": interval, "check_val_every_n_epoch": None, "num_sanity_val_steps": 0}
    trainer = fit(training, [batch()] * 100, clock, validation=[batch(1)] * 4, **often)
    assert (trainer.global_step, clock.now) == (steps, seconds)


def test_the_loss_is_that_of_the_library():
    training = tiny_training(1, loss=Loss(max_disparity=12))
    model = build_model("coex", max_disparity=32)
    model.load_state_dict(training.model.state_dict())
    data = batch(known=0.4)
    expected = stereo_loss(
        model(data["left"], data["right"]),
        data["disparity"],
        auxiliary_weights=model.auxiliary_weights,
        max_disparity=12,
    )
    trainer = fit(training, [data])
    assert trainer.callback_metrics["loss"].item() == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize(("name", "first_level"), [("coex", 0), ("psmnet", 1.5)])
def test_the_cross_entropy_is_of_the_best_head(name, first_level):
    changes = {"model": {"name": name, "max_disparity": 64}, "loss": Loss(max_disparity=30, cross_entropy=0.5)}
    model = build_model(name, max_disparity=64)
    training = StereoTraining(build_model(name, max_disparity=64), replace(TINY, **changes), steps=1)
    training.model.load_state_dict(model.state_dict())
    data = batch(known=0.4)
    output = model(data["left"], data["right"])
    assert output.distribution.first == first_level
    truth = data["disparity"]
    distance = stereo_loss(output, truth, auxiliary_weights=model.auxiliary_weights, max_disparity=30)
    entropy = masked_cross_entropy(output.distribution, truth, max_disparity=30)
    logged = fit(training, [data]).callback_metrics
    assert logged["cross_entropy"].item() == pytest.approx(entropy.item(), rel=1e-4)
    assert logged["loss"].item() == pytest.approx((distance + 0.5 * entropy).item(), rel=1e-4)


class Broken(nn.Module):
    """Leads to an infinite loss where the image is white."""

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.auxiliary_weights = model.auxiliary_weights

    def forward(self, left, right):
        output = self.model(left, right)
        *others, last = output.predictions
        broken = torch.where(left.amin() == 1, math.inf, 1.0) * last.disparity
        return output._replace(predictions=(*others, last._replace(disparity=broken)))


def test_a_step_that_is_not_finite_changes_nothing():
    model = build_model("coex", max_disparity=32)
    training = StereoTraining(Broken(model), TINY, steps=3)
    good = batch()
    white = {**good, "left": torch.ones_like(good["left"])}
    fit(training, [good])
    before = {key: value.clone() for key, value in model.state_dict().items()}
    trainer = fit(training, [white, white])
    assert trainer.callback_metrics["broken_steps"] == training.broken_steps == 2
    after = model.state_dict()
    assert all(torch.equal(before[key], after[key]) for key in before)
    fit(training, [good])
    assert training.broken_steps == 2
    assert any(not torch.equal(before[key], value) for key, value in model.state_dict().items())


def test_training_that_stays_infinite_stops_with_words():
    model = build_model("coex", max_disparity=32)
    training = StereoTraining(Broken(model), TINY, steps=MOST_BROKEN_STEPS + 5)
    data = batch()
    white = {**data, "left": torch.ones_like(data["left"])}
    with pytest.raises(TrainingError, match=f"{MOST_BROKEN_STEPS} steps in a row.*smaller learning rate"):
        fit(training, [white] * (MOST_BROKEN_STEPS + 5))


class Weights(Callback):
    """Keeps the weights after each step."""

    def __init__(self):
        self.seen = []

    def on_train_batch_end(self, trainer, pl_module, *_):
        self.seen.append({key: value.clone() for key, value in pl_module.model.state_dict().items()})


def mean_of(states, shares):
    """The mean that a new state enters with its share."""
    total = {key: value.double() for key, value in states[0].items()}
    for state, share in zip(states[1:], shares[1:], strict=True):
        total = {key: total[key] + share * (value.double() - total[key]) for key, value in state.items()}
    return total


def test_a_plain_mean_begins_anew_where_a_longer_run_is_ahead_of_its_start(monkeypatch):
    progress = iter([0.4, 0.5, 0.9, 0.4, 0.6])
    average = AveragedWeights(Averaging(kind="swa", start=0.5), lambda: next(progress))
    monkeypatch.setattr(WeightAveraging, "on_train_batch_end", lambda *_: None)
    shares = []
    for _ in range(5):
        average.on_train_batch_end(*[None] * 5)
        shares.append(average.share())
    assert shares == [1, 1, 1 / 2, 1, 1]


@pytest.mark.parametrize(
    ("averaging", "shares"),
    [
        (Averaging(kind="ema", decay=0.5), [1 - 2 / 11, 1 - 3 / 12, 1 - 4 / 13, 1 - 5 / 14]),
        (Averaging(kind="ema", decay=0.2), [1 - 2 / 11, 0.8, 0.8, 0.8]),
        (Averaging(kind="swa", start=0.5), [1, 1, 1 / 2, 1 / 3]),
    ],
)
def test_what_is_left_in_the_end_is_the_average(averaging, shares):
    training = tiny_training(4)
    first = {key: value.clone() for key, value in training.model.state_dict().items()}
    weights = Weights()
    average = AveragedWeights(averaging, lambda: training.progress)
    fit(training, [batch(seed + 2) for seed in range(4)], weights, average)
    # AveragedModel takes the weights themselves at its first update
    expected = mean_of(weights.seen, [1, *shares[1:]])
    for key, value in training.model.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value.double(), expected[key], rtol=1e-4, atol=1e-6)
    assert any(not torch.equal(first[key], value) for key, value in training.model.state_dict().items())
