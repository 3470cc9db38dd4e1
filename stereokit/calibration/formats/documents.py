"""YAML, XML and JSON files as one tree of mappings, lists and scalars, and matrices out of it."""

import json
import os
from collections.abc import Mapping
from typing import Any, TypeGuard
from xml.etree import ElementTree

from stereokit.calibration.formats.text import named, numbers, read_text
from stereokit.calibration.formats.yaml_subset import parse_yaml
from stereokit.calibration.rectified import PathLike
from stereokit.errors import InputError

__all__ = ["find_size", "is_matrix", "matrix", "read_document"]

_MAX_DEPTH = 16


def read_document(path: PathLike) -> dict[str, Any]:
    """The content of a YAML, XML or JSON file, by what it begins with.

    Scalars may be text or numbers. Tags of YAML and attributes of XML are passed over.

    Raises:
        InputError: an unreadable or malformed file, or one that is no mapping.
    """
    text = read_text(path).strip()
    with named(path):
        document = _json(text) if text[:1] in "{[" else _xml(text) if text[:1] == "<" else parse_yaml(text)
    if not isinstance(document, dict):
        raise InputError(f"{os.fspath(path)!r} is no calibration: expected named values, got {str(document)[:60]!r}")
    return document


def is_matrix(value: Any) -> TypeGuard[dict[str, Any]]:
    """Whether a value of a document is a matrix as OpenCV and ROS write it: rows, cols and data."""
    return isinstance(value, dict) and "data" in value and ({"rows", "cols"} <= value.keys() or "sizes" in value)


def matrix(path: PathLike, document: Mapping[str, Any], key: str, shape: tuple[int, int]) -> list[float]:
    """The numbers of a matrix, row by row.

    Raises:
        InputError: it is not there, has another shape, or other than `shape[0] * shape[1]` finite numbers.
    """
    value = document.get(key)
    if not is_matrix(value):
        raise InputError(f"{os.fspath(path)!r} has no matrix {key!r}; expected its rows, cols and data")
    claimed = [str(value.get(side))[:20] for side in ("rows", "cols")] if "rows" in value else ["1 dimension"]
    if claimed != [str(side) for side in shape]:
        raise InputError(
            f"{os.fspath(path)!r}: expected a {shape[0]} x {shape[1]} matrix {key}, got {' x '.join(claimed)}"
        )
    data = value["data"]
    return numbers(path, key, data if isinstance(data, str | list) else [], shape[0] * shape[1])


def find_size(path: PathLike, document: Mapping[str, Any]) -> tuple[float, float] | None:
    """Width and height: `image_size` or `imageSize`, or `image_width` and `image_height`, or `width` and `height`.

    Raises:
        InputError: one that is not made of numbers.
    """
    for key in ("image_size", "imageSize"):
        if key in document:
            value = document[key]
            width, height = numbers(path, key, value if isinstance(value, str | list) else [], 2)
            return width, height
    for prefix in ("image_", ""):
        sides = [document.get(prefix + side) for side in ("width", "height")]
        if all(isinstance(side, str | int | float) for side in sides):
            width, height = numbers(path, f"{prefix}width and {prefix}height", sides, 2)
            return width, height
    return None


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"it is no JSON: {str(error)[:100]}") from error


def _xml(text: str) -> Any:
    # entities could make a small file large
    if "<!" in text:
        raise InputError("it is no calibration: OpenCV's XML has no declarations such as <!DOCTYPE ...>")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"it is no XML: {str(error)[:100]}") from error
    return _tree(root, 0)


def _tree(element: ElementTree.Element, depth: int) -> Any:
    if depth > _MAX_DEPTH:
        raise InputError(f"it is no calibration: its XML is nested more than {_MAX_DEPTH} deep")
    if not len(element):
        return (element.text or "").strip()
    return {child.tag: _tree(child, depth + 1) for child in element}
