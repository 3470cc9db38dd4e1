"""PCD of the Point Cloud Library, binary."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

__all__ = ["write_pcd"]


def write_pcd(
    path: Path,
    points: npt.NDArray[np.float32],
    colors: npt.NDArray[np.uint8],
    confidence: npt.NDArray[np.float32] | None,
    comment: str,
) -> None:
    """Writes x y z, rgb (packed in the bits of a float, as the library does) and confidence of each point.

    Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, version 0.7.
    """
    red, green, blue = np.moveaxis(colors.astype(np.uint32), 1, 0)
    packed = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    columns = [*np.moveaxis(points, 1, 0), packed, *([] if confidence is None else [confidence])]
    names = ["x", "y", "z", "rgb", "confidence"][: len(columns)]
    header = [
        f"# {comment}",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(['4'] * len(names))}",
        f"TYPE {' '.join(['F'] * len(names))}",
        f"COUNT {' '.join(['1'] * len(names))}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
        "",
    ]
    rows = np.empty((len(points), len(names)), "<f4")
    for i, values in enumerate(columns):
        # bits are copied, not numbers: a packed colour may look like a NaN
        rows.view("<u4")[:, i] = np.ascontiguousarray(values, "<f4").view("<u4")
    path.write_bytes("\n".join(header).encode("ascii") + rows.tobytes())
