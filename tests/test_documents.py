"""What the library registers stands in the documents, and the other way round."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from stereokit import list_components, list_models
from stereokit.training import list_recipes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
SLOTS = (
    "backbones",
    "candidates",
    "costs",
    "guidance",
    "aggregations",
    "regressions",
    "upsamplers",
    "refinements",
    "losses",
)


def rows(document: str, heading: str) -> dict[str, str]:
    """The rows of the table whose first column has this heading: the first cell, without quotes, to the rest."""
    found: dict[str, str] = {}
    inside = False
    for line in (ROOT / document).read_text(encoding="utf-8").splitlines():
        if line.startswith(f"| {heading} |"):
            inside = True
        elif not line.startswith("|"):
            inside = False
        elif inside and not line.startswith("|---"):
            first, rest = line.strip("| ").split(" | ", 1)
            found[first.strip("`")] = rest
    return found


def test_every_network_has_a_row():
    assert set(rows("docs/networks.md", "network")) == set(list_models())


def test_every_network_has_the_figures_of_its_paper():
    figures = tomllib.loads((ROOT / "benchmarks" / "networks.toml").read_text(encoding="utf-8"))
    assert set(figures) == set(list_models())
    known = {"paper", "licence", "epe", "kitti2012", "kitti2015", "runtime", "remark"}
    assert all("paper" in row and set(row) <= known for row in figures.values())


def test_every_recipe_has_a_row():
    assert set(rows("docs/training.md", "recipe")) == set(list_recipes())


@pytest.mark.parametrize("slot", SLOTS)
def test_every_component_stands_in_the_readme(slot):
    named = rows("README.md", "slot")[slot].split("; at")[0]
    assert set(re.findall(r"`(\w+)`", named)) == set(list_components(slot))


def test_every_link_of_the_documents_leads_somewhere():
    for document in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name}: {target}"
