import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback
from torch import nn

from stereokit.builder import build_model
from stereokit.cli import main
from stereokit.cli.synth import write_scenes
from stereokit.data.disparity_files import write_disparity
from stereokit.data.images import write_image
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import CheckpointError, ConfigError, InputError
from stereokit.inference import Predictor
from stereokit.model import StereoModel
from stereokit.runtime.provenance import file_sha256, state_sha256
from stereokit.training import Machine, Recipe, StereoTraining, TrainingSamples, train, with_length
from stereokit.training.data import StereoData
from stereokit.training.module import TrainingError
from stereokit.training.recipe import Loss
from tests.training.tiny import TINY

REPOSITORY = Path(__file__).parents[2]
CPU = Machine(accelerator="cpu", devices=1, workers=0)
FROM_FILES = """
[model]
name = "coex"
max_disparity = 32
[augmentation]
crop_height = 32
crop_width = 64
[schedule]
batch = 2
epochs = 1
"""


def on_cpu(**settings):
    return replace(CPU, **settings)


def rendered_pairs(folder, count, split="train"):
    """The data set of so many pairs, written below the folder."""
    write_scenes(SyntheticScenes(size=(48, 80), max_disparity=16, count=count), folder / "data", split=split)
    return f"sceneflow/{split}:{folder / 'data'}"


@pytest.fixture(autouse=True)
def _few_validation_scenes(monkeypatch):
    monkeypatch.setattr("stereokit.training.opening.VALIDATION_SCENES", 2)


def test_a_run_leaves_a_network_with_its_record(tmp_path, capsys):
    outcome = train(TINY, tmp_path / "run", machine=on_cpu(checkpoint_every=4, validate_every=3))
    printed = capsys.readouterr().out
    assert printed.startswith("starts from random weights\n")
    assert "6/6 [" in printed
    assert outcome.record["steps"] == 6
    assert outcome.record["pairs_seen"] == 12
    assert set(outcome.record["validation"]) >= {"validation/bad_3", "synthetic/epe"}
    names = {str(path.relative_to(tmp_path / "run")) for path in (tmp_path / "run").rglob("*") if path.is_file()}
    assert {
        "run.json",
        "checkpoints/last.ckpt",
        "best/config.json",
        "best/model.safetensors",
        "best/training.json",
        "logs/csv/version_0/metrics.csv",
        "network/config.json",
        "network/model.safetensors",
        "network/training.json",
        "pictures/synthetic/0_0000003.png",
        "pictures/synthetic/1_0000006.png",
    } <= names
    assert any(name.startswith("logs/tensorboard/") for name in names)
    saved = StereoModel.from_pretrained(outcome.network)
    for key, value in outcome.model.state_dict().items():
        assert torch.equal(saved.state_dict()[key], value)
    assert json.loads((outcome.network / "training.json").read_text())["recipe"]["name"] == "tiny"
    scene = SyntheticScenes(size=(48, 80), max_disparity=16)[0]
    assert Predictor(outcome.network)(scene.left, scene.right).size == (48, 80)


@pytest.mark.parametrize("length", [{"minutes": 1e-3}, {}])
def test_the_end_is_validated_once(tmp_path, monkeypatch, capsys, length):
    ends = []
    monkeypatch.setattr(StereoTraining, "on_validation_end", lambda self: ends.append(self.trainer.global_step))
    outcome = train(TINY, tmp_path, **length, machine=on_cpu(validate_every=5))
    assert ends[-1] == outcome.record["steps"]
    assert len(set(ends)) == len(ends)
    assert outcome.record["validation"]["validation/bad_3"] == outcome.record["validation"]["synthetic/bad_3"]
    assert ("minutes=" in capsys.readouterr().out) == bool(length)


ENDLESS = """
import pathlib, sys, time
from tests.training.tiny import TINY
from stereokit.training import Machine, Recipe, StereoTraining, train
import stereokit.training.opening as opening
opening.VALIDATION_SCENES = 2

start = StereoTraining.on_train_batch_start

def hang(self, *arguments):
    if self.trainer.global_step == 3:
        pathlib.Path(sys.argv[2]).touch()
        time.sleep(3600)
    start(self, *arguments)

if __name__ == "__main__":
    StereoTraining.on_train_batch_start = hang
    machine = Machine(accelerator="cpu", devices=1, workers=1, checkpoint_every=1, validate_every=4)
    train(TINY, sys.argv[1], machine=machine)
"""


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_result_of_an_unbroken_one(tmp_path):
    often = {"machine": on_cpu(checkpoint_every=1, validate_every=4)}
    unbroken = train(TINY, tmp_path / "unbroken", **often)
    script, hangs = tmp_path / "endless.py", tmp_path / "hangs"
    script.write_text(ENDLESS)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "killed"), str(hangs)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        for _ in range(3000):
            if hangs.exists() or process.poll() is not None:
                break
            time.sleep(0.1)
        assert hangs.exists()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    assert torch.load(tmp_path / "killed" / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 3
    resumed = train(TINY, tmp_path / "killed", resume=True, **often)
    assert resumed.record["steps"] == 6
    assert resumed.record["pairs_seen"] == unbroken.record["pairs_seen"]
    for key, value in unbroken.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[key], value, rtol=1e-5, atol=1e-6)
    for key, value in unbroken.record["validation"].items():
        assert resumed.record["validation"][key] == pytest.approx(value, rel=1e-3)


@pytest.mark.slow
def test_a_finished_run_can_be_made_longer(tmp_path, capsys):
    train(with_length(TINY, steps=4), tmp_path, machine=on_cpu(checkpoint_every=2))
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"last.ckpt"}
    with pytest.raises(ConfigError, match="is finished: it is at step 4, and 4 steps were asked for"):
        train(with_length(TINY, steps=4), tmp_path, resume=True, machine=CPU)
    capsys.readouterr()
    longer = train(with_length(TINY, steps=6), tmp_path, resume=True, machine=on_cpu(checkpoint_every=4))
    assert "| 5/6 [" in capsys.readouterr().out
    assert longer.record["steps"] == 6
    assert longer.record["pairs_seen"] == 12
    with pytest.raises(ConfigError, match="is finished: it is at step 6, and 3 steps were asked for"):
        train(with_length(TINY, steps=3), tmp_path, resume=True, machine=CPU)


@pytest.mark.slow
def test_a_run_that_its_minutes_ended_goes_on_with_more_of_them(tmp_path):
    steps = train(TINY, tmp_path, minutes=1e-3, machine=CPU).record["steps"]
    assert steps < 6
    with pytest.raises(ConfigError, match=rf"is finished: it is at step {steps}, and 0.001 minutes were asked for"):
        train(TINY, tmp_path, minutes=1e-3, resume=True, machine=CPU)
    assert train(TINY, tmp_path, minutes=60, resume=True, machine=CPU).record["pairs_seen"] == 12


@pytest.mark.slow
def test_a_run_that_its_steps_ended_goes_on_with_more_of_them_in_the_same_minutes(tmp_path):
    train(with_length(TINY, steps=2), tmp_path, minutes=60, machine=CPU)
    assert train(with_length(TINY, steps=3), tmp_path, minutes=60, resume=True, machine=CPU).record["steps"] == 3


class Killed(BaseException):
    pass


@pytest.mark.slow
def test_a_run_that_is_killed_in_a_validation_repeats_it(tmp_path, monkeypatch):
    often = {"machine": on_cpu(checkpoint_every=2, validate_every=2)}
    unbroken = train(TINY, tmp_path / "unbroken", **often)
    ends, validated = StereoTraining.on_validation_epoch_end, []

    def end(self):
        validated.append(self.trainer.global_step)
        if validated == [2, 4]:
            raise Killed
        ends(self)

    monkeypatch.setattr(StereoTraining, "on_validation_epoch_end", end)
    with pytest.raises(Killed):
        train(TINY, tmp_path / "killed", **often)
    resumed = train(TINY, tmp_path / "killed", resume=True, **often)
    assert validated == [2, 4, 4, 6]
    assert resumed.record["pairs_seen"] == unbroken.record["pairs_seen"]
    for key, value in unbroken.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[key], value, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_a_checkpoint_that_can_not_be_written_leaves_the_one_before(tmp_path, monkeypatch):
    save = Trainer.save_checkpoint

    def full(self, path, *args):
        if self.global_step == 4:
            Path(path).write_bytes(b"part")
            raise OSError(28, "No space left on device")
        save(self, path, *args)

    with monkeypatch.context() as patched:
        patched.setattr(Trainer, "save_checkpoint", full)
        with pytest.raises(OSError, match="No space left"):
            train(TINY, tmp_path, machine=on_cpu(checkpoint_every=2))
    assert "No space left" in json.loads((tmp_path / "run.json").read_text())["ended_by"]
    assert train(TINY, tmp_path, resume=True, machine=on_cpu(checkpoint_every=2)).record["pairs_seen"] == 12
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"last.ckpt"}


def test_running_out_of_memory_is_one_line_and_the_folder_stays_free(tmp_path, monkeypatch):
    def full(self, *_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patched:
        patched.setattr(StereoTraining, "training_step", full)
        with pytest.raises(InputError, match="tiny: a step takes more memory than there is; use a smaller --batch"):
            train(TINY, tmp_path, machine=CPU)
    assert train(with_length(TINY, steps=1, batch=1), tmp_path, machine=CPU).record["pairs_seen"] == 1


def test_a_validation_that_runs_out_of_memory_does_not_blame_the_batch(tmp_path, monkeypatch):
    model = build_model("coex", max_disparity=32)
    forward = StereoModel.forward

    def full(self, left, *args):
        if not self.training:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return forward(self, left, *args)

    monkeypatch.setattr(StereoModel, "forward", full)
    with pytest.raises(InputError, match=r"a validation pair of [0-9]+ x [0-9]+ pixels takes more memory"):
        train(TINY, tmp_path, model=model, machine=CPU)


def test_a_record_that_can_not_be_written_does_not_hide_the_error(tmp_path, monkeypatch):
    def end(self, *_):
        (tmp_path / "run.json").unlink()
        (tmp_path / "run.json").mkdir()
        raise TrainingError("told")

    monkeypatch.setattr(StereoTraining, "training_step", end)
    with pytest.raises(TrainingError, match="told"):
        train(TINY, tmp_path, machine=CPU)


def test_a_run_is_of_the_commit_that_it_started_with(tmp_path, monkeypatch):
    commits = map(str, range(9))
    monkeypatch.setattr(sys.modules[train.__module__], "commit", lambda: next(commits))
    record = train(with_length(TINY, steps=1), tmp_path, machine=CPU).record
    assert {record["commit"], json.loads((tmp_path / "run.json").read_text())["commit"]} == {"0"}


def test_bfloat16_without_instructions_for_it_is_warned_of(tmp_path, monkeypatch):
    monkeypatch.setattr("stereokit.training.trainer.cpu_has", lambda _: False)
    with pytest.warns(UserWarning, match="no instructions for bfloat16, so that precision 'bf16-mixed' is slower"):
        train(with_length(TINY, steps=1), tmp_path, machine=on_cpu(precision="bf16-mixed"))


def test_an_interruption_stays_one(tmp_path, monkeypatch):
    def interrupt(self, *_):
        raise KeyboardInterrupt

    monkeypatch.setattr(StereoTraining, "training_step", interrupt)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(TINY, tmp_path, machine=CPU)
    assert signal.getsignal(signal.SIGINT) is handler


def written_pairs(folder, disparity):
    """Two pairs of noise in the layout of `folder`, with one disparity everywhere."""
    for index in range(2):
        (folder / str(index)).mkdir(parents=True)
        for view in ("left", "right"):
            noise = np.random.default_rng(index).integers(0, 256, (48, 80, 3), np.uint8)
            write_image(folder / str(index) / f"{view}.png", noise)
        write_disparity(folder / str(index) / "disparity.pfm", np.full((48, 80), disparity, np.float32))
    return f"folder:{folder}"


def test_validation_pairs_without_truth_that_counts_do_not_end_a_run(tmp_path):
    right, wrong = written_pairs(tmp_path / "right", 5), written_pairs(tmp_path / "wrong", -5)
    with pytest.warns(UserWarning, match="no pixel of the validation pairs has ground truth that counts"):
        train(with_length(TINY, steps=1), tmp_path / "run", data=[right], validation=[wrong], machine=CPU)
    assert not (tmp_path / "run" / "best").exists()


def test_training_on_nothing_is_refused_ahead(tmp_path):
    right, wrong = written_pairs(tmp_path / "right", 5), written_pairs(tmp_path / "wrong", -5)
    for data in ([wrong], [right, wrong]):
        with pytest.raises(InputError, match=r"wrong: no pixel of the ground truth counts, .*100 % are negative"):
            train(TINY, tmp_path / "run", data=data, machine=CPU)
    with pytest.raises(InputError, match=r"rendered scenes: no pixel .* at or above max_disparity"):
        train(replace(TINY, loss=Loss(max_disparity=1e-3)), tmp_path / "run", machine=CPU)
    assert not (tmp_path / "run").exists()


def kinds(network):
    return [type(module) for module in network.modules()]


@pytest.mark.parametrize("interrupted", [False, True])
@pytest.mark.parametrize("moved", [False, True])
def test_the_network_that_was_given_keeps_its_classes_and_learns(tmp_path, monkeypatch, interrupted, moved):
    model = build_model("coex", max_disparity=32).eval()
    model.register_forward_hook(lambda *_: None)
    before, classes = {key: value.clone() for key, value in model.state_dict().items()}, kinds(model)
    weights, hooks = list(map(id, model.parameters())), dict(model._forward_hooks)
    if moved:
        # as to a GPU, where buffers are others
        monkeypatch.setattr(StereoTraining, "setup", lambda self, stage: self._apply(torch.clone))
    if interrupted:
        start = StereoTraining.on_train_batch_start

        def interrupt(self, *arguments):
            start(self, *arguments)
            if self.trainer.global_step == 2:
                raise KeyboardInterrupt

        monkeypatch.setattr(StereoTraining, "on_train_batch_start", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(TINY, tmp_path, model=model, machine=CPU)
    else:
        outcome = train(TINY, tmp_path, model=model, machine=CPU)
        assert outcome.model is model
        saved = StereoModel.from_pretrained(outcome.network).state_dict()
        assert all(torch.equal(value, saved[key]) for key, value in model.state_dict().items())
    assert kinds(model) == classes
    assert list(map(id, model.parameters())) == weights
    assert model._forward_hooks == hooks
    assert list(model.state_dict()) == list(before)
    assert not any(module.training for module in model.modules())
    changed = [key for key, value in model.state_dict().items() if not torch.equal(value, before[key])]
    assert any("running_mean" in key for key in changed)
    assert any("weight" in key for key in changed)


@pytest.mark.slow
def test_a_run_that_is_killed_in_its_last_validation_still_has_its_end_to_come(tmp_path, monkeypatch):
    def kill(self):
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(StereoTraining, "on_validation_epoch_end", kill)
        with pytest.raises(Killed):
            train(TINY, tmp_path, machine=on_cpu(checkpoint_every=4))
    outcome = train(TINY, tmp_path, resume=True, machine=on_cpu(checkpoint_every=4))
    assert (outcome.record["steps"], outcome.record["pairs_seen"]) == (6, 12)
    assert outcome.record["validation"]


def test_only_the_run_that_is_there_is_resumed(tmp_path):
    run = tmp_path / "run"
    train(with_length(TINY, steps=1), run, machine=CPU)
    with pytest.raises(InputError, match="holds a run already; go on with it by --resume"):
        train(TINY, run, machine=CPU)
    with pytest.raises(ConfigError, match="was started with seed 0, not 1"):
        train(TINY, run, seed=1, resume=True, machine=CPU)
    with pytest.raises(ConfigError, match=r"schedule.batch 2, not 4"):
        train(with_length(TINY, batch=4), run, resume=True, machine=CPU)
    data = rendered_pairs(tmp_path, 1, split="test")
    with pytest.raises(ConfigError, match=r"was started with validate \[\], not"):
        train(TINY, run, validation=[data], resume=True, machine=CPU)
    with pytest.raises(ConfigError, match="was started with start None"):
        train(TINY, run, model=build_model("coex", max_disparity=32), resume=True, machine=CPU)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(InputError, match="is not empty and holds no run"):
        train(TINY, tmp_path / "other", machine=CPU)
    (run / "checkpoints" / "last.ckpt").write_bytes(b"broken")
    with pytest.raises(CheckpointError, match=r"last.ckpt.* can't be read"):
        train(TINY, run, resume=True, machine=CPU)


@pytest.mark.slow
def test_a_run_from_before_a_setting_existed_is_resumed(tmp_path):
    train(with_length(TINY, steps=1), tmp_path, machine=CPU)
    record = json.loads((tmp_path / "run.json").read_text())
    del record["recipe"]["loss"]["cross_entropy"]
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match="was started with loss"):
        train(with_length(replace(TINY, loss=Loss(cross_entropy=1)), steps=2), tmp_path, resume=True, machine=CPU)
    enlarged = replace(TINY, augmentation=replace(TINY.augmentation, scale_range=(1.0, 1.5)))
    with pytest.raises(ConfigError, match=r"with augmentation {'scale_range': \[1.0, 1.0\]}, not {'scale_range': \[1"):
        train(with_length(enlarged, steps=2), tmp_path, resume=True, machine=CPU)
    assert train(with_length(TINY, steps=2), tmp_path, resume=True, machine=CPU).record["steps"] == 2


@pytest.mark.slow
def test_photographs_are_known_by_their_content(tmp_path):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in ("a.png", "brick.png"):
        write_image(photographs / name, np.full((40, 40, 3), 90, np.uint8))
    recipe = with_length(TINY, steps=1)
    record = train(recipe, tmp_path / "run", textures=photographs, machine=CPU).record
    assert record["textures"] == {name: file_sha256(photographs / name) for name in ("a.png", "brick.png")}
    moved = photographs.rename(tmp_path / "moved")
    assert (
        train(with_length(TINY, steps=2), tmp_path / "run", textures=moved, resume=True, machine=CPU).record["steps"]
        == 2
    )
    write_image(moved / "brick.png", np.full((40, 40, 3), 91, np.uint8), overwrite=True)
    with pytest.raises(ConfigError, match=r"was started with textures {'brick.png': "):
        train(with_length(TINY, steps=3), tmp_path / "run", textures=moved, resume=True, machine=CPU)


def test_settings_that_do_not_go_together(tmp_path):
    files = replace(TINY, scenes=None, data="kitti2015/train:ROOT")
    with pytest.raises(InputError, match="give --data kitti2015/train:ROOT"):
        train(files, tmp_path / "run", machine=CPU)
    with pytest.raises(ConfigError, match="minutes is -1"):
        train(TINY, tmp_path / "run", minutes=-1, machine=CPU)
    with pytest.raises(ConfigError, match=r"\[scenes\].*'bars'"):
        train(replace(TINY, scenes={"bars": 3}), tmp_path / "run", machine=CPU)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["kitti-finetune", "psmnet-kitti"])
def test_a_recipe_for_fine_tuning_wants_weights(tmp_path, name, capsys):
    data = ["--data", f"kitti2015/train:{tmp_path}"]
    assert main(["train", "--recipe", name, *data, "--out", str(tmp_path / "run")]) == 2
    assert "goes on from a trained" in (said := capsys.readouterr().err)
    assert "give --weights" in said
    assert not (tmp_path / "run").exists()


def test_a_network_to_go_on_from_is_what_the_recipe_says(tmp_path):
    start = build_model("coex", max_disparity=64, top_k=3)
    with pytest.raises(ConfigError, match=r"is for max_disparity 32, and the network .* has max_disparity 64"):
        train(TINY, tmp_path / "run", model=start, machine=CPU)
    with pytest.raises(ConfigError, match="is for name 'psmnet', and the network to go on from has name 'coex'"):
        train(replace(TINY, model={"name": "psmnet"}), tmp_path / "run", model=start, machine=CPU)
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="network-from weights has no effect without --weights"):
        train(TINY, tmp_path / "run", network_from="weights", machine=CPU)
    with pytest.raises(ConfigError, match="network_from is 'given'; use 'recipe' or 'weights'"):
        train(TINY, tmp_path / "run", model=start, network_from="given", machine=CPU)
    given = {"model": start, "network_from": "weights", "machine": CPU}
    outcome = train(with_length(TINY, steps=1), tmp_path / "as_it_is", **given)
    assert outcome.model.config == outcome.record["recipe"]["model"] == start.config
    # what the recipe leaves open may differ, and networks come in eval mode
    recipe = with_length(replace(TINY, model={"name": "coex"}), steps=1)
    outcome = train(recipe, tmp_path / "run", model=start.eval(), machine=CPU)
    assert outcome.model.config == start.config
    assert any("running_mean" in name and value.abs().sum() > 0 for name, value in outcome.model.named_buffers())


@pytest.mark.parametrize(
    ("kind", "words"),
    [("smooth_l2", "did you mean 'smooth_l1'"), ({"name": "smooth_l1", "beta": 2}, "no argument 'beta'")],
)
def test_a_loss_that_nobody_knows_is_refused(tmp_path, kind, words):
    with pytest.raises(ConfigError, match=words):
        train(replace(TINY, loss=Loss(kind=kind)), tmp_path / "run", machine=CPU)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("seed", [-1, 2**32, 1.0, True])
def test_a_seed_is_a_whole_number(tmp_path, seed):
    with pytest.raises(ConfigError, match=r"seed is .*; expected a whole number from 0"):
        train(TINY, tmp_path / "run", seed=seed, machine=CPU)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("schedule", "optimisation"),
    [
        ({"kind": "one_cycle", "warmup": 0.3}, {"kind": "rmsprop", "gradient_clip": 0.1, "gradient_clip_by": "value"}),
        ({"kind": "exponential", "factor": 0.5}, {"kind": "adamw", "weight_decay": 0.01}),
    ],
)
def test_other_optimisers_and_schedules_run_and_resume(tmp_path, schedule, optimisation):
    values = {**TINY.to_dict(), "schedule": {"batch": 2, "steps": 1, **schedule}, "optimisation": optimisation}
    recipe = Recipe.from_dict(values)
    train(recipe, tmp_path, machine=CPU)
    for key in ("schedule", "optimisation"):
        other = with_length(replace(recipe, **{key: getattr(TINY, key)}), steps=2)
        with pytest.raises(ConfigError, match=f"was started with {key}"):
            train(other, tmp_path, resume=True, machine=CPU)
    assert train(with_length(recipe, steps=2), tmp_path, resume=True, machine=CPU).record["steps"] == 2


@pytest.mark.slow
def test_the_best_network_is_kept(tmp_path, monkeypatch):
    found = iter([30.0, 10.0, 20.0])
    ends = StereoTraining.on_validation_epoch_end

    def end(self):
        ends(self)
        self.errors["validation/bad_3"] = next(found)

    monkeypatch.setattr(StereoTraining, "on_validation_epoch_end", end)
    train(TINY, tmp_path, machine=on_cpu(validate_every=2))
    record = json.loads((tmp_path / "best" / "training.json").read_text())
    assert (record["steps"], record["validation"]["validation/bad_3"]) == (4, 10.0)
    best = StereoModel.from_pretrained(tmp_path / "best")
    assert state_sha256(best.state_dict()) == record["weights_sha256"]
    last = json.loads((tmp_path / "network" / "training.json").read_text())
    assert last["weights_sha256"] != record["weights_sha256"]
    # the checkpoint of the end does not know the validation of its step
    found = iter([15.0, 5.0])
    for steps, best in ((7, 10.0), (8, 5.0)):
        train(with_length(TINY, steps=steps), tmp_path, resume=True, machine=on_cpu(validate_every=steps))
        record = json.loads((tmp_path / "best" / "training.json").read_text())
        assert record["validation"]["validation/bad_3"] == best


@pytest.mark.slow
def test_the_length_changes_from_epochs_to_steps(tmp_path):
    recipe = replace(TINY, schedule=replace(TINY.schedule, steps=None, epochs=3, milestones=(1.0,)))
    recipe = replace(recipe, scenes={**TINY.scenes, "count": 2})
    train(recipe, tmp_path, machine=CPU)
    more = replace(recipe, schedule=replace(recipe.schedule, epochs=4))
    assert train(more, tmp_path, resume=True, machine=CPU).record["steps"] == 4
    longer = train(with_length(recipe, steps=5), tmp_path, resume=True, machine=CPU)
    assert longer.record["steps"] == 5
    other = replace(recipe, schedule=replace(recipe.schedule, epochs=6, milestones=(3.0,)))
    with pytest.raises(ConfigError, match=r"was started with schedule\.milestones"):
        train(other, tmp_path, resume=True, machine=CPU)


def test_pairs_without_ground_truth_are_refused_ahead(tmp_path):
    data = rendered_pairs(tmp_path, 2)
    for view in ("left", "right"):
        (tmp_path / "pairs" / view).mkdir(parents=True)
        for image in sorted((tmp_path / "data").rglob(f"{view}/*.png")):
            (tmp_path / "pairs" / view / image.name).write_bytes(image.read_bytes())
    blind = f"folder:{tmp_path / 'pairs'}"
    for sets in ({"data": [blind]}, {"data": [data], "validation": [blind]}):
        with pytest.raises(InputError, match=r"2 of 2 pairs of 'folder:.*' have no ground truth"):
            train(TINY, tmp_path / "run", **sets, machine=CPU)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("resume", [False, True])
def test_a_broken_file_is_one_line_and_the_folder_stays_free(tmp_path, resume):
    data = [rendered_pairs(tmp_path, 2)]
    image = sorted((tmp_path / "data").rglob("left/*.png"))[0]
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    recipe, settings = with_length(TINY, steps=1), {"machine": on_cpu(workers=1)}
    with pytest.raises(InputError) as caught:
        train(recipe, tmp_path / "run", data=data, **settings)
    assert "\n" not in str(caught.value)
    assert image.name in str(caught.value)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["ended_by"] == str(caught.value)
    image.write_bytes(whole)
    assert train(recipe, tmp_path / "run", data=data, resume=resume, machine=CPU).record["steps"] == 1
    assert "ended_by" not in json.loads((tmp_path / "run" / "run.json").read_text())


@pytest.mark.slow
def test_training_from_files_goes_on_from_weights(tmp_path, capsys):
    data = rendered_pairs(tmp_path, 3)
    start = build_model("coex", max_disparity=32)
    start.save_pretrained(tmp_path / "start")
    recipe = tmp_path / "mine.toml"
    recipe.write_text(FROM_FILES + "[optimisation]\nlearning_rate = 1e-9\n")
    arguments = ["train", "--recipe", str(recipe), "--weights", str(tmp_path / "start"), "--accelerator", "cpu"]
    arguments += ["--data", data, "--workers", "0"]
    assert main([*arguments, "--out", str(tmp_path / "run"), "--validate", data]) == 0
    printed = capsys.readouterr().out
    assert "\nvalidation/bad_3" not in printed
    assert f"starts from the weights {tmp_path / 'start'}\n" in printed
    assert "2 steps, 4 pairs" in printed
    assert "sceneflow/train/bad_3" in printed
    trained = StereoModel.from_pretrained(tmp_path / "run" / "network")
    for key, value in start.named_parameters():
        torch.testing.assert_close(trained.get_parameter(key), value, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_several_validation_sets_have_a_mean(tmp_path, capsys):
    data = rendered_pairs(tmp_path, 2)
    recipe = tmp_path / "mine.toml"
    recipe.write_text(FROM_FILES)
    arguments = ["train", "--recipe", str(recipe), "--out", str(tmp_path / "run"), "--accelerator", "cpu"]
    assert main([*arguments, "--data", data, "--workers", "0", "--validate", data, "--validate", data]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in printed[-6:]] == [
        f"{name}/{metric}"
        for name in ("sceneflow/train", "sceneflow/train_1", "validation")
        for metric in ("bad_3", "epe")
    ]
    assert printed[-1].endswith("(mean over the sets)")


def test_nothing_is_said_that_does_not_help(tmp_path, caplog, recwarn):
    data = [rendered_pairs(tmp_path, 2)]
    files = replace(with_length(TINY, steps=1), scenes=None)
    for length in (1, 2):
        outcome = train(with_length(files, steps=length), tmp_path / "run", data=data, resume=length > 1, machine=CPU)
        assert outcome.record["validation"] == {}
    assert [record.getMessage() for record in caplog.records] == []
    assert [str(warning.message) for warning in recwarn] == []
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()


def test_the_command_explains(tmp_path, capsys):
    assert main(["train", "--recipe", "scenflow", "--out", str(tmp_path / "run")]) == 2
    assert "did you mean 'sceneflow'" in capsys.readouterr().err
    assert main(["train", "--recipe", "synthetic", "--out", str(tmp_path / "run"), "--devices", "two"]) == 2
    assert "--devices is a number of devices, or auto" in capsys.readouterr().err
    assert main(["train", "--recipe", "synthetic", "--out", str(tmp_path / "run"), "--top-k", "7"]) == 2
    assert "--top-k can only be given for published checkpoints; use --weights" in capsys.readouterr().err
    assert main(["train", "--recipe", "sceneflow", "--out", str(tmp_path / "run")]) == 2
    assert "give --data sceneflow/train:ROOT" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"accelerator": "tpu"}, "accelerator 'tpu'"),
        ({"accelerator": "abacus"}, "accelerator 'abacus'"),
        ({"precision": "31"}, "precision '31'.*bf16-mixed"),
    ],
)
def test_what_the_machine_does_not_have_is_one_line(tmp_path, given, words, capsys):
    with pytest.raises(ConfigError, match=words) as caught:
        train(TINY, tmp_path / "run", machine=on_cpu(**given))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


class Gradients(Callback):
    """Freezes batch statistics, which CPU processes do not share, and writes the gradient of the first step."""

    def __init__(self, path):
        self.path = path

    def on_train_batch_start(self, trainer, pl_module, *_):
        for module in pl_module.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        if trainer.is_global_zero:
            torch.save({name: p.grad for name, p in pl_module.named_parameters() if p.grad is not None}, self.path)


def gradients(path, processes):
    class Sparse(SyntheticScenes):
        """The part of the truth that is known differs from pair to pair."""

        def __getitem__(self, index):
            sample = super().__getitem__(index)
            sample.disparity[: 10 * (index % 4)] = torch.nan
            return sample

    torch.manual_seed(0)
    recipe = replace(TINY, loss=Loss(cross_entropy=1))
    training = StereoTraining(build_model("coex", max_disparity=32), recipe, steps=1)
    samples = TrainingSamples([Sparse(size=(48, 80), max_disparity=16)], TINY.augmentation, seed=0)
    trainer = Trainer(
        accelerator="cpu",
        devices=processes,
        strategy="ddp_fork" if processes > 1 else "auto",
        max_steps=1,
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[Gradients(path)],
    )
    trainer.fit(training, StereoData(samples, batch=4, steps=1, validation={}, workers=0))
    return torch.load(path, weights_only=True)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
@pytest.mark.slow
def test_two_processes_have_the_gradient_of_one_with_the_joint_batch(tmp_path):
    alone = gradients(tmp_path / "1.pt", 1)
    # in a process that has not computed a gradient yet, whose threads a fork would lose
    program = f"from tests.training.test_run import gradients; gradients({str(tmp_path / '2.pt')!r}, 2)"
    subprocess.run(
        [sys.executable, "-c", program], check=True, cwd=REPOSITORY, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    together = torch.load(tmp_path / "2.pt", weights_only=True)
    assert alone.keys() == together.keys()
    largest = max(gradient.abs().max() for gradient in alone.values())
    assert largest > 0
    for name, gradient in alone.items():
        torch.testing.assert_close(together[name], gradient, rtol=1e-3, atol=1e-5 * float(largest))


def test_processes_without_a_validation_pair_get_one_that_does_not_count():
    scenes = SyntheticScenes(size=(48, 80), max_disparity=16, count=3)
    samples = TrainingSamples([scenes], TINY.augmentation, seed=0)
    data = StereoData(samples, batch=2, steps=1, validation={"one": [scenes[0]], "all": list(scenes)}, workers=0)
    known = []
    for rank in range(2):
        data.trainer = SimpleNamespace(world_size=2, global_rank=rank)
        known.append([[bool(b["disparity"].isfinite().any()) for b in loader] for loader in data.val_dataloader()])
    assert known == [[[True], [True, True]], [[False], [True]]]


def test_a_batch_that_does_not_divide_is_refused(tmp_path):
    class Two:
        world_size, global_rank = 2, 0

    samples = TrainingSamples([SyntheticScenes(size=(48, 80), max_disparity=16)], TINY.augmentation, seed=0)
    data = StereoData(samples, batch=3, steps=1, validation={}, workers=0)
    data.trainer = Two()
    with pytest.raises(ConfigError, match="batch of 3 does not divide among 2 processes"):
        data.train_dataloader()
