"""The table of all networks in docs/networks.md: what their papers say, and what was measured here in one run.

    python benchmarks/networks.py                      # times all of them, in turns: about a quarter of an hour
    python benchmarks/networks.py --bench times.json   # takes the times of a `stereokit bench .. --json times.json`
    python benchmarks/networks.py --figure docs/networks.svg

Published figures are kept in benchmarks/networks.toml; parameters and multiply-adds are counted. Times and memory are
those of `stereokit bench` on a CPU, of the networks as `Predictor` runs them.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from stereokit import StereoKitError, build_model, list_models
from stereokit.bench import Candidate, run_benchmark, source_of
from stereokit.bench.summary import model_summary
from stereokit.errors import InputError
from stereokit.files import atomic_path
from stereokit.runtime.memory import format_memory
from stereokit.tables import counted

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = ROOT / "benchmarks" / "networks.toml"
DOCUMENT = ROOT / "docs" / "networks.md"
PLACE = re.compile(r"(<!-- networks -->\n).*(<!-- end of networks -->)", re.DOTALL)
COLUMNS = (
    "network",
    "parameters",
    "GMACs",
    "EPE [px]",
    "KITTI 2012 [%]",
    "KITTI 2015 [%]",
    "published [ms]",
    "here [ms]",
    "to CoEx",
    "memory",
    "source",
    "licence of the source",
    "remark",
)
TEXT = ("network", "source", "licence of the source", "remark")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bench", type=Path, help="JSON of an earlier run, in place of a new one")
    parser.add_argument("--size", nargs=2, type=int, default=(256, 512), metavar=("H", "W"), help="(default: 256 512)")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs of each (default: 3)")
    parser.add_argument("--json", type=Path, help="where the new run is kept")
    parser.add_argument("--figure", type=Path, help="time against parameters, as .svg or .png (extra: viz)")
    options = parser.parse_args()
    try:
        published = _published()
        run = (
            _measured(options, list(published))
            if options.bench is None
            else json.loads(options.bench.read_text(encoding="utf-8"))
        )
        times = {row["name"]: row for row in run["rows"]}
        rows = [_row(name, facts, times.get(name), times.get("coex")) for name, facts in published.items()]
        _write(rows, run)
        if options.figure is not None:
            _draw(times, options.figure)
    except StereoKitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _published() -> dict[str, dict[str, Any]]:
    facts: dict[str, dict[str, Any]] = tomllib.loads(PUBLISHED.read_text(encoding="utf-8"))
    names = set(list_models())
    if names ^ set(facts):
        raise InputError(
            f"{PUBLISHED.name} and the registered networks differ: {', '.join(sorted(names ^ set(facts)))}"
        )
    return facts


def _measured(options: argparse.Namespace, names: list[str]) -> dict[str, Any]:
    height, width = options.size
    candidates = [Candidate(name, source_of(name), height=height, width=width) for name in names]
    found = run_benchmark(
        candidates, repeats=options.repeats, warmup=1, command="python benchmarks/networks.py", progress=tqdm
    )
    if options.json is not None:
        found.save(options.json, overwrite=True)
    run: dict[str, Any] = json.loads(found.to_json())
    return run


def _row(name: str, facts: dict[str, Any], timed: dict[str, Any] | None, coex: dict[str, Any] | None) -> dict[str, str]:
    with torch.random.fork_rng(devices=[]):
        blocks = model_summary(build_model(name))
    row = {
        "network": f"`{name}`",
        "parameters": f"{sum(block.parameters for block in blocks):,}",
        "GMACs": f"{sum(block.multiply_adds for block in blocks) / 1e9:.1f}",
        "EPE [px]": _given(facts, "epe"),
        "KITTI 2012 [%]": _given(facts, "kitti2012"),
        "KITTI 2015 [%]": _given(facts, "kitti2015"),
        "published [ms]": _given(facts, "runtime"),
        "source": facts["paper"],
        "licence of the source": facts.get("licence", "none"),
        "remark": facts.get("remark", ""),
    }
    if timed is not None and timed["error"] is None:
        row["here [ms]"] = f"{1000 * timed['median_seconds']:,.0f}"
        row["memory"] = format_memory(timed["peak_memory"]) if timed["peak_memory"] is not None else ""
        if coex is not None and coex["error"] is None:
            row["to CoEx"] = f"{timed['median_seconds'] / coex['median_seconds']:.1f}"
    return row


def _given(facts: dict[str, Any], key: str) -> str:
    return str(facts.get(key, ""))


def _write(rows: list[dict[str, str]], run: dict[str, Any]) -> None:
    first = run["rows"][0]
    machine = run["machine"]
    lines = [
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "|".join("---" if column in TEXT else "---:" for column in COLUMNS) + "|",
        *("| " + " | ".join(row.get(column, "") for column in COLUMNS) + " |" for row in rows),
        "",
        f"Times and memory: {first['height']} x {first['width']} px, {first['precision']}, median of "
        f"{counted(run['settings']['repeats'], 'run')} in turns, {machine['torch_threads']} threads of "
        f"{machine['processor']}, torch {run['versions']['torch']}.",
    ]
    if not all("here [ms]" in row for row in rows):
        lines.append("Networks without a time were not in that run.")
    text = DOCUMENT.read_text(encoding="utf-8")
    if not PLACE.search(text):
        raise InputError(f"{DOCUMENT} has no place for the table, from <!-- networks --> to <!-- end of networks -->")
    table = "\n".join(lines)
    with atomic_path(DOCUMENT, overwrite=True) as temporary:
        temporary.write_text(PLACE.sub(lambda found: f"{found[1]}{table}\n{found[2]}", text), encoding="utf-8")
    print(table)


def _draw(times: dict[str, dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    timed = [row for row in times.values() if row["error"] is None]
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot()
    axes.scatter([row["parameters"] / 1e6 for row in timed], [row["median_seconds"] for row in timed], s=18)
    for row in timed:
        place = (row["parameters"] / 1e6, row["median_seconds"])
        axes.annotate(row["name"], place, xytext=(4, 3), textcoords="offset points", fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="parameters [millions]", ylabel="time of a pair [s]")
    axes.grid(visible=True, which="both", alpha=0.2)
    with atomic_path(path, overwrite=True) as temporary:
        figure.savefig(temporary, dpi=150)


if __name__ == "__main__":
    sys.exit(main())
