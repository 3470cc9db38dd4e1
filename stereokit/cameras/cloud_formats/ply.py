"""PLY, binary little endian."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["write_ply"]


def write_ply(
    path: Path,
    points: npt.NDArray[np.float32],
    colors: npt.NDArray[np.uint8],
    confidence: npt.NDArray[np.float32] | None,
    comment: str,
) -> None:
    """Writes x y z (float), red green blue (uchar) and confidence (float) of each point.

    Source: G. Turk, The PLY Polygon File Format, 1994.
    """
    fields: list[tuple[str, str, str, npt.NDArray[Any]]] = [
        *((name, "float", "<f4", points[:, i]) for i, name in enumerate("xyz")),
        *((name, "uchar", "u1", colors[:, i]) for i, name in enumerate(("red", "green", "blue"))),
    ]
    if confidence is not None:
        fields.append(("confidence", "float", "<f4", confidence))
    header = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {len(points)}"]
    header += [f"property {kind} {name}" for name, kind, _, _ in fields]
    vertices = np.empty(len(points), [(name, dtype) for name, _, dtype, _ in fields])
    for name, _, _, values in fields:
        vertices[name] = values
    path.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii") + vertices.tobytes())
