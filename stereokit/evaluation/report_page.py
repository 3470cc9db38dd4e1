"""The HTML of a report: templates and what fills them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from stereokit.evaluation.results import DatasetResult, Evaluation, PairResult
from stereokit.evaluation.tables import NOTHING, dataset_table, notes, pair_table
from stereokit.pictures import KITTI_ERROR_COLORS
from stereokit.pictures.errors import NO_PREDICTION_COLOR
from stereokit.pictures.page import Figure, figures, page, table
from stereokit.tables import counted, share

__all__ = ["Card", "evaluation_page"]


@dataclass(frozen=True)
class Card:
    """A pair and its pictures."""

    result: PairResult
    figures: tuple[Figure, ...]


_RULES = Template("""$sections
<section>
<h2>How these numbers were made</h2>
<dl>$rules</dl>
<details><summary>Model, settings, machine and versions</summary><pre>$record</pre></details>
</section>""")

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
$figures
</article>
""")


def evaluation_page(
    evaluation: Evaluation, rows: Mapping[str, Sequence[PairResult]], cards: Mapping[str, Sequence[Card]]
) -> str:
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
    body = _RULES.substitute(
        sections="".join(
            _section(number, result, rows[result.name], cards.get(result.name, ()), taus)
            for number, result in enumerate(evaluation.datasets, 1)
        ),
        rules="".join(f"<dt>{escape(term)}</dt><dd>{escape(rule)}</dd>" for term, rule in evaluation.masks.items()),
        record=escape(json.dumps(evaluation.record(), indent=2)),
    )
    return page(f"Stereo evaluation: {name}", " · ".join(facts), body)


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
        table=table(dataset_table(result, taus)),
        notes=f'<ul class="notes">{remarks}</ul>' if remarks else "",
        shown=escape(shown),
        rows=table(pair_table(rows, taus), anchors),
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
        figures=figures(card.figures, card.result.name),
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
