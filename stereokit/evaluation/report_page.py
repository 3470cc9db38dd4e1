"""The HTML of a report: templates and what fills them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from stereokit.evaluation.results import DatasetResult, Evaluation, PairResult
from stereokit.evaluation.tables import NOTHING, dataset_table, notes, pair_table, share
from stereokit.pictures import KITTI_ERROR_COLORS
from stereokit.pictures.errors import NO_PREDICTION_COLOR
from stereokit.tables import Table, counted

__all__ = ["Card", "Figure", "page"]


@dataclass(frozen=True)
class Figure:
    """A picture: its title, a note beside it, and its content as a data URI."""

    title: str
    note: str
    data_uri: str


@dataclass(frozen=True)
class Card:
    """A pair and its pictures."""

    result: PairResult
    figures: tuple[Figure, ...]


_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>$title</title>
<style>$style</style>
</head>
<body>
<header>
<h1>$title</h1>
<p class="facts">$facts</p>
</header>
<main>
$sections
<section>
<h2>How these numbers were made</h2>
<dl>$rules</dl>
<details><summary>Model, settings, machine and versions</summary><pre>$record</pre></details>
</section>
</main>
</body>
</html>
""")

_SECTION = Template("""<section>
<h2>$name</h2>
<p class="facts">$facts</p>
$table
$notes
<h3>Pairs, worst first</h3>
<p class="facts">Sorted by D1. $shown</p>
<div class="wide">$rows</div>
$legend
$cards
</section>
""")

_CARD = Template("""<article id="$anchor">
<h4><span class="rank">$rank</span> $name <span class="chips">$chips</span></h4>
<div class="figures">$figures</div>
</article>
""")

_FIGURE = Template("""<figure>
<figcaption>$title <small>$note</small></figcaption>
<img src="$source" alt="$title of $name">
</figure>
""")

_STYLE = """
:root { --ink: #1d2733; --quiet: #5b6875; --line: #dde3e9; --paper: #f5f7f9; --accent: #1f5f99; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
header, main { max-width: 1360px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 32px; }
h1 { font-size: 28px; line-height: 1.2; margin: 0; }
h2 { font-size: 19px; margin: 0; overflow-wrap: anywhere; }
h3 { font-size: 16px; margin: 28px 0 0; }
h4 { font-size: 15px; margin: 0 0 10px; display: flex; flex-wrap: wrap; gap: 6px 10px; align-items: baseline; }
.facts, .notes { color: var(--quiet); margin: 4px 0 14px; overflow-wrap: anywhere; }
.notes { padding-left: 18px; margin-top: 12px; }
section { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 24px; margin: 24px 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 14px 5px 0; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--quiet); font-weight: 600; font-size: 13px; }
th:first-child, td:first-child { text-align: left; }
tbody tr:hover { background: var(--paper); }
.wide { overflow: auto; max-height: 420px; }
.wide th { position: sticky; top: 0; background: #fff; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
.legend { display: flex; flex-wrap: wrap; gap: 4px 14px; margin: 22px 0 0; font-size: 13px; color: var(--quiet); }
.legend i { display: inline-block; width: 22px; height: 12px; margin-right: 5px; border-radius: 2px; }
article { border-top: 1px solid var(--line); margin-top: 22px; padding-top: 18px; scroll-margin-top: 8px; }
.rank { color: var(--quiet); font-weight: 400; }
.chips { display: flex; flex-wrap: wrap; gap: 6px; font-weight: 400; font-size: 13px; }
.chips span { background: var(--paper); border: 1px solid var(--line); border-radius: 99px; padding: 0 9px; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); gap: 14px; }
figure { margin: 0; }
figcaption { font-size: 13px; margin-bottom: 3px; }
figcaption small { color: var(--quiet); font-size: inherit; }
img { display: block; width: 100%; height: auto; border-radius: 4px; background: #000; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 18px; }
dt { font-weight: 600; }
dd { margin: 0; color: var(--quiet); }
pre { font-size: 12px; overflow-x: auto; background: var(--paper); padding: 14px; border-radius: 6px; }
summary { cursor: pointer; }
@media (max-width: 600px) { header, main { padding: 0 10px; } section { padding: 14px; } dl { display: block; } }
@media print { body { background: #fff; } .wide { max-height: none; } article { break-inside: avoid; } }
"""


def page(evaluation: Evaluation, rows: Mapping[str, Sequence[PairResult]], cards: Mapping[str, Sequence[Card]]) -> str:
    """The whole page.

    Args:
        evaluation: the numbers.
        rows: for each data set's name its pairs, in the order to show.
        cards: for each data set's name the pairs to show in pictures, in the same order.
    """
    model = evaluation.model
    name = model.get("configuration", {}).get("name") or model.get("name") or model.get("class") or model["matcher"]
    machine = evaluation.machine
    device = str(model.get("device", ""))
    processor = ", ".join(machine["accelerators"]) if device.startswith("cuda") else machine["processor"]
    weights = [f"weights {Path(model['weights']).name}"] if "weights" in model else []
    facts = [
        *weights,
        counted(sum(len(result.pairs) for result in evaluation.datasets), "pair"),
        f"{device}: {processor}" if device else processor,
        evaluation.started,
        f"stereokit {evaluation.versions['stereokit']}",
    ]
    taus = evaluation.settings["taus"]
    return _PAGE.substitute(
        title=escape(f"Stereo evaluation: {name}"),
        style=_STYLE,
        facts=escape(" · ".join(facts)),
        sections="".join(
            _section(number, result, rows[result.name], cards.get(result.name, ()), taus)
            for number, result in enumerate(evaluation.datasets, 1)
        ),
        rules="".join(f"<dt>{escape(term)}</dt><dd>{escape(rule)}</dd>" for term, rule in evaluation.masks.items()),
        record=escape(json.dumps(evaluation.record(), indent=2)),
    )


def _section(
    number: int, result: DatasetResult, rows: Sequence[PairResult], cards: Sequence[Card], taus: Sequence[float]
) -> str:
    anchors = {card.result.name: f"pair-{number}-{rank}" for rank, card in enumerate(cards, 1)}
    pairs = counted(len(result.pairs), "pair")
    remarks = "".join(f"<li>{escape(line)}</li>" for line in notes(result))
    shown = "" if len(cards) == len(rows) else f"Pictures of the worst {len(cards)} of {len(rows)}."
    return _SECTION.substitute(
        name=escape(result.name),
        facts=escape(f"split {result.split} · {pairs} · median {result.median_seconds:.3f} s per pair"),
        table=_table(dataset_table(result, taus)),
        notes=f'<ul class="notes">{remarks}</ul>' if remarks else "",
        shown=escape(shown),
        rows=_table(pair_table(rows, taus), anchors),
        legend=_legend() if cards else "",
        cards="".join(_card(anchors[card.result.name], rank, card, taus) for rank, card in enumerate(cards, 1)),
    )


def _card(anchor: str, rank: int, card: Card, taus: Sequence[float]) -> str:
    name = escape(card.result.name)
    return _CARD.substitute(
        anchor=anchor,
        rank=rank,
        name=name,
        chips="".join(f"<span>{escape(chip)}</span>" for chip in _chips(card.result, taus)),
        figures="".join(
            _FIGURE.substitute(title=figure.title, note=escape(figure.note), source=figure.data_uri, name=name)
            for figure in card.figures
        ),
    )


def _chips(pair: PairResult, taus: Sequence[float]) -> list[str]:
    chips = []
    metrics = pair.metrics or {}
    if metrics:
        chips += [_chip("D1", metrics["d1"], "%"), _chip("EPE", metrics["epe"], "px")]
        chips += [_chip(f"bad-{tau:g}", metrics[f"bad_{tau:g}"], "%") for tau in taus]
    else:
        chips.append("no ground truth")
    if pair.invalid_pixels:
        chips.append(f"{share(pair.invalid_pixels, pair.width * pair.height)} of the pixels not predicted")
    return [*chips, f"{pair.seconds:.3f} s"]


def _chip(name: str, value: float | None, unit: str) -> str:
    return f"{name} {NOTHING}" if value is None else f"{name} {value:.2f} {unit}"


def _table(table: Table, anchors: Mapping[str, str] | None = None) -> str:
    """Rows whose first cell has an anchor link to it."""
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    body = ""
    for first, *cells in table.rows:
        anchor = (anchors or {}).get(first)
        label = f'<a href="#{anchor}">{escape(first)}</a>' if anchor else escape(first)
        body += f"<tr><td>{label}</td>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>\n"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _legend() -> str:
    """The error picture's colours: of |d - d*|, or of 60 |d - d*| / d* where that is smaller."""
    entries: list[tuple[Any, str]] = []
    lower = 0.0
    for upper, color in KITTI_ERROR_COLORS:
        entries.append((color, f"{lower:g} to {upper:g}" if upper < float("inf") else f"above {lower:g}"))
        lower = upper
    entries += [(NO_PREDICTION_COLOR, "no prediction"), ((0, 0, 0), "unknown")]
    swatches = "".join(
        f'<span><i style="background: rgb{tuple(color)}"></i>{escape(label)}</span>' for color, label in entries
    )
    return f'<div class="legend"><span>Error in px, yellow to red for outliers of D1:</span>{swatches}</div>'
