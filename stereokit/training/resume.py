"""The folder of a run: what it was started with, and going on with it."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError, printable
from stereokit.files import make_folder, write_json
from stereokit.training.fields import brief, is_number
from stereokit.training.recipe import Recipe

__all__ = ["RunFolder"]


@dataclass(frozen=True)
class RunFolder:
    """Where all that a run writes lies."""

    path: Path

    @property
    def record(self) -> Path:
        """What was asked for, and the error that ended the run, if one did."""
        return self.path / "run.json"

    @property
    def last(self) -> Path:
        """The checkpoint to go on from."""
        return self.path / "checkpoints" / "last.ckpt"

    @property
    def best(self) -> Path:
        """The network that validated best."""
        return self.path / "best"

    @property
    def network(self) -> Path:
        """The network of the end."""
        return self.path / "network"

    def prepare(self, asked: Mapping[str, Any], circumstances: Mapping[str, Any], *, resume: bool) -> None:
        """Makes the folder of a new run, or sees that the one there is of the same run.

        Raises:
            InputError: the folder holds a run already, or something else.
            ConfigError: the run there was started with other settings.
        """
        if self.record.exists() and resume:
            before = _read_json(self.record)
            if not isinstance(before.get("recipe"), dict):
                raise CheckpointError(f"{printable(self.record)} is damaged: it holds no recipe; choose another --out")
            self._check_same_run(before, asked)
            if before.pop("ended_by", None) is not None:
                write_json(self.record, before, overwrite=True)
            return
        if self.record.exists() and not self._failed_at_once():
            raise InputError(
                f"{str(self.path)!r} holds a run already; go on with it by --resume, or choose another --out"
            )
        if not self.record.exists() and self.path.exists() and any(self.path.iterdir()):
            raise InputError(f"the folder {str(self.path)!r} is not empty and holds no run; choose another --out")
        make_folder(self.last.parent)
        write_json(self.record, {**asked, **circumstances}, overwrite=True)

    def check_checkpoint(self, steps: int, minutes: float | None) -> None:
        """Sees that there is something left to do.

        Raises:
            CheckpointError: the checkpoint can't be read.
            ConfigError: the run has come to its end.
        """
        try:
            checkpoint = torch.load(self.last, map_location="cpu", weights_only=True)
        except Exception as error:  # the reader of a damaged file may stumble over anything
            raise CheckpointError(f"the checkpoint {str(self.last)!r} can't be read: {error}") from error
        if not isinstance(checkpoint, dict) or "stereokit" not in checkpoint:
            raise CheckpointError(f"{str(self.last)!r} is no checkpoint of stereokit train")
        own = checkpoint["stereokit"]
        done, ended_by = checkpoint.get("global_step"), own.get("ended_by_minutes") if isinstance(own, dict) else own
        if type(done) is not int or not (ended_by is None or is_number(ended_by)):
            raise CheckpointError(f"{str(self.last)!r} is damaged: it does not say how far the run has come")
        if done >= steps or (minutes is not None and ended_by is not None and minutes <= ended_by):
            length = f"{steps} steps" if done >= steps else f"{minutes:g} minutes"
            raise ConfigError(
                f"the run in {str(self.path)!r} is finished: it is at step {done}, and {length} were asked for; "
                "a larger --steps or --minutes makes it longer"
            )

    def best_bad_3(self) -> float | None:
        """Of the best network so far; None if there is none."""
        record = self.best / "training.json"
        if not record.is_file():
            return None
        try:
            return float(_read_json(record)["validation"]["validation/bad_3"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{printable(record)} is damaged: it does not say how well the network validated; remove its folder"
            ) from error

    def note_end(self, error: Exception) -> None:
        """Writes down the error that ended the run."""
        ended_by = str(error) if isinstance(error, StereoKitError) else f"{type(error).__name__}: {error}"
        # such as a full disk, which is what is to be told
        with suppress(StereoKitError):
            write_json(self.record, {**_read_json(self.record), "ended_by": ended_by}, overwrite=True)

    def _failed_at_once(self) -> bool:
        """Whether an error ended the run before there was anything to lose."""
        left = (*self.path.glob("checkpoints/*"), *self.path.glob("best"), *self.path.glob("network"))
        return "ended_by" in _read_json(self.record) and not left

    def _check_same_run(self, before: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
        """Sees that what is asked for is the run that the folder holds."""
        runs = before, json.loads(json.dumps(asked))
        # milestones stay the same epochs where there are more of these, or the same parts of the run
        differing = min((_differing(*(_settled(run, parts) for run in runs)) for parts in (True, False)), key=len)
        for key, (value, wanted) in differing.items():
            if isinstance(value, Mapping) and isinstance(wanted, Mapping):
                value, wanted = _without_common(value, wanted), _without_common(wanted, value)
            raise ConfigError(
                f"{str(self.path)!r} was started with {key} {brief(value, 200)}, not {brief(wanted, 200)}; "
                "resume it with the same, or choose another --out"
            )


def _settled(run: Mapping[str, Any], in_parts: bool) -> dict[str, Any]:
    """What can't change between the start of a run and its resumption: all but its length."""
    # with the defaults of what a run before knew nothing of
    recipe = Recipe.from_dict(run["recipe"])
    values = recipe.to_dict()
    schedule = dict(values.pop("schedule"))
    if in_parts:
        of_a_step = recipe.schedule.of_steps(1)
        schedule["milestones"] = [round(at, 9) for at in of_a_step.milestones]
        schedule["every"] = round(of_a_step.every, 9)
    del schedule["steps"], schedule["epochs"]
    settled = {key: run[key] for key in ("seed", "data", "textures", "validate", "start") if key in run}
    return {**settled, **values, **{f"schedule.{key}": value for key, value in schedule.items()}}


def _differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {key: (value, now[key]) for key, value in before.items() if key in now and now[key] != value}


def _without_common(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in others or others[key] != value}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{printable(path)} can't be read: {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{printable(path)} is damaged: it holds {brief(content)}; expected the record of a run")
    return content
