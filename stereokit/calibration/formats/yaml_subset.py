"""A small reader of YAML as calibration files use it, in a time that grows with the length of the text.

Block mappings and sequences by indentation, flow sequences over one or several lines, quoted and plain scalars,
comments. Tags such as OpenCV's `!!opencv-matrix` are passed over, so no file can make objects. Scalars stay text.
"""

import re
from typing import TypeAlias

from stereokit.errors import InputError

__all__ = ["Node", "parse_yaml"]

Node: TypeAlias = "str | list[Node] | dict[str, Node]"

_MAX_DEPTH = 8
_KEY = re.compile(r"""("[^"]*"|'[^']*'|[^\s:#\[\]{},"'][^:#\[\]{},"']*):(?=\s|$)""")
_FLOW_TOKEN = re.compile(r"""[\[\],]|"[^"]*"|'[^']*'|[^\[\],"']+""")
_TAG = re.compile(r"^!\S*\s*")

_Line: TypeAlias = tuple[int, str]
"""Indentation and content."""


def parse_yaml(text: str) -> Node:
    """Mappings, lists and text out of YAML.

    Raises:
        InputError: the text uses what this reader does not know, or is nested deeper than any calibration.

    >>> parse_yaml("%YAML:1.0\\n---\\nsize: [3,\\n  4] # of the image\\ncam0:\\n  T:\\n  - [1, 0]\\n  - [0, 1]\\n")
    {'size': ['3', '4'], 'cam0': {'T': [['1', '0'], ['0', '1']]}}
    """
    lines = _joined(_content(text))
    if not lines:
        return {}
    node, end = _block(lines, 0, 0)
    if end < len(lines):
        raise InputError(f"no YAML that can be read: {lines[end][1][:60]!r} is indented less than what is before it")
    return node


def _content(text: str) -> list[_Line]:
    """The lines that say something."""
    result = []
    for line in text.splitlines():
        content = _uncommented(line).strip()
        if content and not content.startswith(("%", "---", "...")):
            result.append((len(line) - len(line.lstrip()), content))
    return result


def _uncommented(line: str) -> str:
    if "#" not in line:
        return line
    quote = ""
    for i, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter == "#" and (i == 0 or line[i - 1].isspace()):
            return line[:i]
    return line


def _joined(lines: list[_Line]) -> list[_Line]:
    """The lines, those of a flow sequence as one."""
    result: list[_Line] = []
    parts: list[str] = []
    open_brackets = indent = 0
    for depth, content in lines:
        if not parts:
            indent = depth
        parts.append(content)
        open_brackets += content.count("[") - content.count("]")
        if open_brackets <= 0:
            result.append((indent, " ".join(parts)))
            parts, open_brackets = [], 0
    if parts:
        raise InputError(f"no YAML that can be read: a list that begins in {parts[0][:60]!r} does not end")
    return result


def _block(lines: list[_Line], start: int, depth: int) -> tuple[Node, int]:
    """The mapping, list or scalar whose first line is `start`, and the number of the line behind it."""
    if depth > _MAX_DEPTH:
        raise InputError(f"no calibration: its YAML is nested more than {_MAX_DEPTH} deep")
    indent, content = lines[start]
    if _is_item(content):
        return _sequence(lines, start, indent)
    if not _KEY.match(content):
        return _scalar(content), start + 1
    mapping: dict[str, Node] = {}
    at = start
    while at < len(lines) and lines[at][0] == indent and (key := _KEY.match(lines[at][1])):
        value = _TAG.sub("", lines[at][1][key.end() :].strip())
        at += 1
        if value:
            node: Node = _scalar(value)
        elif at < len(lines) and (lines[at][0] > indent or (lines[at][0] == indent and _is_item(lines[at][1]))):
            node, at = _block(lines, at, depth + 1)
        else:
            node = ""
        mapping[key[1].strip("\"'").strip()] = node
    if at < len(lines) and lines[at][0] >= indent:
        raise InputError(f"no YAML that can be read: expected 'key: value', got {lines[at][1][:60]!r}")
    return mapping, at


def _sequence(lines: list[_Line], start: int, indent: int) -> tuple[Node, int]:
    items: list[Node] = []
    at = start
    while at < len(lines) and lines[at][0] == indent and _is_item(lines[at][1]):
        items.append(_scalar(lines[at][1][1:].strip()))
        at += 1
    if at < len(lines) and lines[at][0] > indent:
        raise InputError(f"no YAML that can be read: expected a list item, got {lines[at][1][:60]!r}")
    return items, at


def _is_item(content: str) -> bool:
    return content == "-" or content.startswith("- ")


def _scalar(text: str) -> Node:
    if text.startswith("["):
        return _flow(text)
    return text.strip("\"'")


def _flow(text: str) -> Node:
    stack: list[list[Node]] = [[]]
    for token in _FLOW_TOKEN.findall(text):
        if token == "[":
            if len(stack) > _MAX_DEPTH:
                raise InputError(f"no calibration: its lists are nested more than {_MAX_DEPTH} deep")
            stack.append([])
        elif token == "]":
            if len(stack) == 1:
                raise InputError(f"no YAML that can be read: a list too many ends in {text[:60]!r}")
            items = stack.pop()
            stack[-1].append(items)
        elif token != "," and token.strip():
            stack[-1].append(token.strip().strip("\"'"))
    if len(stack) > 1 or len(stack[0]) != 1:
        raise InputError(f"no YAML that can be read: {text[:60]!r} is no list")
    return stack[0][0]
