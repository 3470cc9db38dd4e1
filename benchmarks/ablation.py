"""Trains the rows of the CoEx paper's ablation on rendered scenes, and prints them beside the paper's numbers.

    python benchmarks/ablation.py --out runs/ablation --minutes 20

Every row has the same scenes, seeds and budget, given in minutes or in steps; with steps, rows see equally many
scenes whatever they cost. Rows are named TABLE-NUMBER; --list shows them. A row that is done is not done again, one
that was broken off is resumed: the same command goes on. The errors are of scenes of another seed.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from stereokit import StereoKitError, StereoModel, build_model
from stereokit.data.synthetic import SyntheticScenes
from stereokit.files import write_json
from stereokit.metrics import StereoMetrics
from stereokit.models.ablation import ABLATION, AblationRow
from stereokit.training import Machine, Recipe, load_recipe, train, with_length
from stereokit.training.samples import to_batch

TEST_SEED = 2_000_003


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for the runs")
    parser.add_argument("--list", action="store_true", help="name the rows, and end")
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="which (default: all of CoEx)")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--minutes", type=float, help="training time of a row")
    budget.add_argument("--steps", type=int, help="training steps of a row")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--crop", nargs=2, type=int, default=(192, 384), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--test-scenes", type=int, default=100)
    parser.add_argument("--accelerator", default="auto")
    parser.add_argument("--precision", default="32")
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    rows = named_rows()
    if options.list:
        for name, row in rows.items():
            print(f"{name}: {describe(row)}")
        return 0
    if options.out is None or (options.minutes is None and options.steps is None):
        parser.error("give --out, and --minutes or --steps")
    chosen = options.rows or [name for name, row in rows.items() if row.model == "coex"]
    unknown = [name for name in chosen if name not in rows]
    if unknown:
        parser.error(f"there are no rows {', '.join(unknown)}; see --list")
    try:
        results = {name: result_of(rows[name], name, options) for name in chosen}
    except StereoKitError as error:
        print(f"ablation: {error}", file=sys.stderr)
        return 2
    print(table({name: rows[name] for name in chosen}, results))
    return 0


def named_rows() -> dict[str, AblationRow]:
    counts: dict[str, int] = {}
    named = {}
    for row in ABLATION:
        counts[row.table] = counts.get(row.table, 0) + 1
        named[f"{row.table}-{counts[row.table]}"] = row
    return named


def settings_of(row: AblationRow) -> dict[str, Any]:
    """The overrides of a row in one form, whichever way the row says them."""
    settings = {"cost": "correlation", "guidance_at": "full", **plain(row.overrides)}
    if "top_k" in settings:
        settings["regression"] = {"name": "top_k", "k": settings.pop("top_k")}
    return settings


def describe(row: AblationRow) -> str:
    settings = settings_of(row)
    regression, guidance = settings["regression"], settings["guidance"]
    k = f"k = {regression['k']}" + (f" -> {regression['test_k']}" if regression.get("test_k") else "")
    where = f" {settings['guidance_at']}" if guidance != "none" else ""
    return f"{row.model}, {settings['cost']}, guidance {guidance}{where}, {k}"


def result_of(row: AblationRow, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Trains and tests a row, or reads what was found before."""
    path = options.out / f"{name}.json"
    asked = {key: getattr(options, key) for key in ("minutes", "steps", "batch", "seed", "test_scenes", "precision")}
    asked["crop"] = list(options.crop)
    asked["recipe"] = recipe_of(options, row.model, {}).to_dict()
    if path.is_file():
        before = json.loads(path.read_text(encoding="utf-8"))
        if {**before["asked"], "recipe": with_defaults(before["asked"].get("recipe"))} != asked:
            raise StereoKitError(f"{str(path)!r} is of another budget: {before['asked']}; choose another --out")
        return dict(before)
    print(f"{name}: {describe(row)}", file=sys.stderr)
    # rows that train alike, whatever they test, share a run
    at_test = settings_of(row)
    overrides = {**at_test, "regression": {**at_test["regression"], "test_k": None}}
    network, run = trained(row.model, overrides, asked, options)
    model = build_model(row.model, **at_test)
    model.load_state_dict(network.state_dict())
    result = {"asked": asked, "row": describe(row), "run": run, **tested(model, asked, options)}
    write_json(path, result)
    return result


def recipe_of(options: argparse.Namespace, model: str, overrides: dict[str, Any]) -> Recipe:
    recipe = with_length(load_recipe("synthetic"), steps=options.steps or 1_000_000, batch=options.batch)
    height, width = options.crop
    return replace(
        recipe,
        model={"name": model, **overrides},
        augmentation=replace(recipe.augmentation, crop_height=height, crop_width=width),
        scenes={**(recipe.scenes or {}), "size": [height + 32, width + 64]},
    )


def with_defaults(stored: dict[str, Any] | None) -> dict[str, Any] | None:
    """A stored recipe with the defaults of what it knew nothing of; None for a record without one."""
    return None if stored is None else Recipe.from_dict(stored).to_dict()


def trained(
    model: str, overrides: dict[str, Any], asked: dict[str, Any], options: argparse.Namespace
) -> tuple[StereoModel, dict[str, Any]]:
    budget = {**asked, "crop": "x".join(map(str, options.crop)), "test_scenes": None, "recipe": None}
    recipe = recipe_of(options, model, overrides)
    folder = options.out / "runs" / "_".join(words(budget)) / "_".join([model, *words(overrides)])
    if (folder / "network" / "training.json").is_file():
        record = json.loads((folder / "network" / "training.json").read_text(encoding="utf-8"))
        if with_defaults(record["recipe"]) != recipe.to_dict():
            raise StereoKitError(f"{str(folder)!r} was trained by another recipe; choose another --out")
        return StereoModel.from_pretrained(folder / "network"), summary(record)
    outcome = train(
        recipe,
        folder,
        seed=options.seed,
        minutes=options.minutes,
        resume=True,
        machine=Machine(
            accelerator=options.accelerator,
            devices=1,
            precision=options.precision,
            workers=options.workers,
            checkpoint_every=100,
            validate_every=1_000_000,
        ),
    )
    return outcome.model, summary(outcome.record)


def summary(record: Mapping[str, Any]) -> dict[str, Any]:
    return {key: record[key] for key in ("steps", "pairs_seen", "seconds", "commit", "machine")}


@torch.inference_mode()
def tested(model: StereoModel, asked: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    device = torch.device("cuda" if torch.cuda.is_available() and options.accelerator != "cpu" else "cpu")
    model.eval().to(device)
    settings = {**asked["recipe"]["scenes"], "size": tuple(options.crop)}
    scenes = SyntheticScenes(**settings, seed=TEST_SEED, count=options.test_scenes)
    metrics = StereoMetrics()
    for index in tqdm(range(len(scenes)), unit="scene", leave=False):
        batch = to_batch(scenes[index])
        disparity = model(batch["left"].to(device), batch["right"].to(device)).disparity
        metrics.update(disparity.cpu(), batch["disparity"])
    counted = metrics.compute()
    return {key: counted[key] for key in ("epe", "bad_1", "bad_3")}


def plain(value: Any) -> Any:
    return {key: plain(part) for key, part in value.items()} if isinstance(value, Mapping) else value


def words(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [f"{key}-{'-'.join(words(part))}" for key, part in sorted(value.items()) if part is not None]
    return [str(value)]


def table(rows: Mapping[str, AblationRow], results: Mapping[str, Mapping[str, Any]]) -> str:
    lines = [
        ["row", "network", "scenes seen", "EPE [px]", "bad-3 [%]", "paper: EPE, SceneFlow [px]", "bad-3 [%]"],
        ["---", "---", *["---:"] * 5],
    ]
    for name, row in rows.items():
        result = results[name]
        paper = "" if row.bad3 is None else f"{row.bad3:.2f}"
        seen = f"{result['run']['pairs_seen']:,}"
        lines.append(
            [name, describe(row), seen, f"{result['epe']:.3f}", f"{result['bad_3']:.2f}", f"{row.epe:.3f}", paper]
        )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
