import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from stereokit.errors import ConfigError
from stereokit.training import Schedule

part = st.floats(0, 1)
warmups = st.one_of(st.just(0.0), st.floats(0.01, 0.9))


@st.composite
def schedules(draw, kinds=("milestones", "one_cycle", "exponential")):
    kind = draw(st.sampled_from(kinds))
    epochs = draw(st.one_of(st.none(), st.integers(1, 50)))
    end, warmup = epochs or 1, draw(warmups)
    settings = {}
    if kind == "milestones":
        milestones = draw(st.lists(st.floats(0.01, 0.99), max_size=4))
        settings = {"milestones": tuple(at * end for at in milestones), "factor": draw(st.floats(0.01, 1))}
    elif kind == "exponential":
        settings = {"factor": draw(st.floats(0.01, 1)), "every": draw(st.floats(0.1, 1)) * end}
    else:
        settings = {"final": draw(part), "shape": draw(st.sampled_from(["cosine", "linear"]))}
        if warmup:
            settings["initial"] = draw(part)
    length = {"steps": draw(st.integers(1, 1000))} if epochs is None else {"epochs": epochs}
    return Schedule(batch=draw(st.integers(1, 9)), kind=kind, warmup=warmup, **length, **settings)


@given(schedules(), part)
def test_the_recipes_rate_is_the_largest(schedule, progress):
    assert 0 <= schedule.learning_rate_factor(progress) <= 1 + 1e-12


@given(schedules(), part, part)
def test_after_the_warmup_the_rate_never_rises(schedule, a, b):
    early, late = sorted((a, b))
    assume(early >= schedule.warmup)
    assert schedule.learning_rate_factor(late) <= schedule.learning_rate_factor(early) + 1e-12


@given(schedules(kinds=["one_cycle", "milestones"]), part, part)
def test_within_the_warmup_the_rate_never_falls(schedule, a, b):
    early, late = sorted((a * schedule.warmup, b * schedule.warmup))
    assume(late < min((at / (schedule.epochs or 1) for at in schedule.milestones), default=1))
    assert schedule.learning_rate_factor(early) <= schedule.learning_rate_factor(late) + 1e-12


@given(schedules(kinds=["one_cycle", "exponential"]), part)
def test_the_rate_has_no_jumps(schedule, progress):
    step = 1e-7
    steepest = 2 / min(schedule.warmup or 1, 1 - schedule.warmup)
    if schedule.kind == "exponential":
        steepest += -math.log(schedule.factor) * (schedule.epochs or 1) / schedule.every
    near = schedule.learning_rate_factor(min(progress + step, 1))
    assert abs(near - schedule.learning_rate_factor(progress)) <= 1.01 * step * steepest + 1e-12


@given(schedules(), part, st.integers(1, 500))
def test_the_same_course_over_a_number_of_steps(schedule, progress, steps):
    other = schedule.of_steps(steps)
    assert (other.total_steps(17), other.epochs) == (steps, None)
    end = schedule.epochs or 1
    # a milestone may fall on the progress itself
    assume(all(abs(at / end - progress) > 1e-9 for at in schedule.milestones))
    assert other.learning_rate_factor(progress) == pytest.approx(schedule.learning_rate_factor(progress), rel=1e-9)


def rates_of(scheduler, steps):
    """The rate of each step, by one of torch's schedulers."""
    rates = []
    for _ in range(steps):
        rates.append(scheduler.optimizer.param_groups[0]["lr"])
        scheduler.optimizer.step()
        scheduler.step()
    return rates


@given(
    st.integers(2, 60).flatmap(lambda steps: st.tuples(st.just(steps), st.integers(1, steps - 1))),
    st.floats(0.001, 1),
    st.floats(0.001, 1),
    st.sampled_from(["cosine", "linear"]),
)
def test_one_cycle_is_that_of_torch(lengths, initial, final, shape):
    steps, rising = lengths
    schedule = Schedule(
        batch=1,
        steps=steps,
        kind="one_cycle",
        warmup=rising / steps,
        initial=initial,
        final=initial * final,
        shape=shape,
    )
    scheduler = torch.optim.lr_scheduler.OneCycleLR(
        torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1),
        max_lr=1,
        # torch is at its end in its last step, ours after it
        total_steps=steps + 1,
        pct_start=(rising + 1) / (steps + 1),
        anneal_strategy={"cosine": "cos", "linear": "linear"}[shape],
        cycle_momentum=False,
        div_factor=1 / initial,
        final_div_factor=1 / final,
    )
    ours = [schedule.learning_rate_factor(step / steps) for step in range(steps)]
    assert ours == pytest.approx(rates_of(scheduler, steps), rel=1e-6, abs=1e-9)
    assert schedule.learning_rate_factor(rising / steps) == 1
    assert schedule.learning_rate_factor(1) == pytest.approx(initial * final)


@given(st.integers(1, 30), st.floats(0.1, 1))
def test_at_the_epochs_the_exponential_is_that_of_torch(epochs, factor):
    schedule = Schedule(batch=1, epochs=epochs, kind="exponential", factor=factor)
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1)
    scheduler = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=factor)
    ours = [schedule.learning_rate_factor(epoch / epochs) for epoch in range(epochs)]
    assert ours == pytest.approx(rates_of(scheduler, epochs), rel=1e-9)


def test_the_warmup_rises_from_nothing_in_a_line():
    schedule = Schedule(batch=1, steps=10, warmup=0.2)
    assert [schedule.learning_rate_factor(p) for p in (0, 0.05, 0.1, 0.2, 0.9)] == pytest.approx([0, 0.25, 0.5, 1, 1])


def test_steps_are_counted_from_epochs():
    assert Schedule(batch=8, epochs=10).total_steps(35_454) == -(-35_454 * 10 // 8)
    assert Schedule(batch=4, steps=7).total_steps(1) == 7


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"kind": "cosine"}, "kind is 'cosine'; expected 'milestones', 'one_cycle' or 'exponential'"),
        ({"kind": "one_cycle", "milestones": (0.5,)}, r"milestones = \(0.5,\) has no effect with kind 'one_cycle'"),
        ({"kind": "exponential", "shape": "linear"}, "shape = 'linear' has no effect .* or choose kind 'one_cycle'"),
        ({"final": 0.5}, "final = 0.5 has no effect with kind 'milestones'"),
        ({"kind": "one_cycle", "initial": 0.5}, "initial = 0.5 has no effect without a warmup"),
        ({"kind": "one_cycle", "final": 1.5}, "final is a part of the learning rate from 0 to 1; got 1.5"),
        ({"kind": "exponential", "every": 0}, "every must be positive, got 0"),
    ],
)
def test_what_does_not_go_together_is_explained(given, words):
    with pytest.raises(ConfigError, match=words):
        Schedule(batch=1, steps=10, **given)
