"""Pages of HTML that hold their pictures and their style: they open from disk and load nothing."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from string import Template
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.tables import Table

__all__ = ["MAX_WIDTH", "Figure", "exact", "figures", "page", "photograph", "table"]

MAX_WIDTH = 960
"""Of a picture in a page, in pixels."""

_JPEG_QUALITY = 88


@dataclass(frozen=True)
class Figure:
    """A picture: its title, a note beside it, and its content as a data URI."""

    title: str
    note: str
    data_uri: str


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
$body
</main>
</body>
</html>
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


def page(title: str, facts: str, body: str) -> str:
    """A whole page; its content-security policy forbids scripts and the network.

    Args:
        title: plain text.
        facts: a line below it, plain text.
        body: HTML.
    """
    return _PAGE.substitute(title=escape(title), style=_STYLE, facts=escape(facts), body=body)


def figures(shown: Sequence[Figure], name: str) -> str:
    """Pictures beside each other.

    Args:
        shown: the pictures.
        name: what they are of, for those who can't see them.
    """
    drawn = (
        _FIGURE.substitute(
            title=escape(one.title), note=escape(one.note), source=one.data_uri, name=escape(name, quote=True)
        )
        for one in shown
    )
    return f'<div class="figures">{"".join(drawn)}</div>'


def table(content: Table, anchors: Mapping[str, str] | None = None) -> str:
    """A table; rows whose first cell has an anchor link to it."""
    head = "".join(f"<th>{escape(column)}</th>" for column in content.columns)
    body = ""
    for first, *cells in content.rows:
        anchor = (anchors or {}).get(first)
        label = f'<a href="#{anchor}">{escape(first)}</a>' if anchor else escape(first)
        body += f"<tr><td>{label}</td>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>\n"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def photograph(rgb: npt.NDArray[np.uint8]) -> str:
    """A picture as the data URI of a JPEG, at most `MAX_WIDTH` wide."""
    return _data_uri(_shrunk(rgb, cv2.INTER_AREA), "jpeg", [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def exact(rgb: npt.NDArray[np.uint8]) -> str:
    """The same of a PNG: single pixels and colours that mean something stay as they are."""
    return _data_uri(_shrunk(rgb, cv2.INTER_NEAREST), "png", [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _shrunk(rgb: npt.NDArray[np.uint8], interpolation: int) -> npt.NDArray[Any]:
    height, width = rgb.shape[:2]
    if width <= MAX_WIDTH:
        return rgb
    return cv2.resize(rgb, (MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))), interpolation=interpolation)


def _data_uri(rgb: npt.NDArray[Any], kind: str, options: list[int]) -> str:
    _, encoded = cv2.imencode(f".{kind}", np.ascontiguousarray(rgb[:, :, ::-1]), options)
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"
