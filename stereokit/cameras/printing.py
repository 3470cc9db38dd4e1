"""A board on paper, in true size, with a ruler to check it by."""

import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.boards import Board, CharucoBoard
from stereokit.cameras.targets import board_size, dark_rectangles, draw_rectangles
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = ["PAPERS", "BoardSheet"]

PAPERS = {
    "a4": (0.297, 0.210),
    "letter": (0.2794, 0.2159),
    "a3": (0.420, 0.297),
    "a2": (0.594, 0.420),
    "a1": (0.841, 0.594),
    "a0": (1.189, 0.841),
}
"""Width and height in metres, the longer side first."""

_MARGIN = 0.006  # which printers leave white
_FOOT = 0.016  # for the ruler and the words
_TEXT = 0.0028  # height of capitals and more
_POINT = 0.0254 / 72
_MOST_PIXELS = 2 * 10**8


@dataclass(frozen=True)
class BoardSheet:
    """A board in the middle of a sheet of paper, above a ruler of 100 mm and words that say what it is.

    Attributes:
        board: what to print.
        paper: one of `PAPERS`, or "600x400mm"; the smallest that fits by default.

    Raises:
        InputError: unknown paper, or a board that does not fit it.

    >>> from stereokit.cameras.boards import Checkerboard
    >>> BoardSheet(Checkerboard(9, 6, 0.025)).size
    (0.297, 0.21)
    """

    board: Board
    paper: str | None = None

    def __post_init__(self) -> None:
        self._fitting()

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the paper in metres, turned as the board is."""
        return self._fitting()

    @property
    def words(self) -> tuple[str, ...]:
        """What stands below the board: what it is, and how to print it."""
        board = self.board
        square = f"squares {board.square * 1e3:g} mm"
        if isinstance(board, CharucoBoard):
            layout = ", layout before OpenCV 4.6" if board.legacy else ""
            what = f"ChArUco {board.columns} x {board.rows} squares, {square}, markers {board.marker * 1e3:g} mm"
            what += f", {board.dictionary}{layout}"
        else:
            what = f"Checkerboard {board.columns} x {board.rows} inner corners, {square}"
        return what, "Print at 100 %, not fitted to the page. The ruler must measure 100 mm."

    def write(self, path: str | os.PathLike[str], *, dpi: int = 300, overwrite: bool = False) -> None:
        """Writes the sheet.

        Args:
            path: ends in .pdf, or in .png.
            dpi: pixels per inch of a PNG, which says so itself.
            overwrite: replace an existing file.

        Raises:
            InputError: another suffix, a resolution out of range, or a file that can't be written.
        """
        suffix = Path(path).suffix.lower()
        if suffix not in (".pdf", ".png"):
            raise InputError(f"{os.fspath(path)!r}: a board is written as .pdf or .png")
        width, height = self.size
        pixels = width * height * (dpi / 0.0254) ** 2
        if dpi < 72 or (suffix == ".png" and pixels > _MOST_PIXELS):
            raise InputError(
                f"a sheet of {width:g} x {height:g} m at {dpi} dpi; expected 72 or more, and 200 MP at most"
            )
        content = self._pdf() if suffix == ".pdf" else self._png(dpi)
        with atomic_path(path, overwrite=overwrite) as temporary:
            temporary.write_bytes(content)

    def _fitting(self) -> tuple[float, float]:
        across, down = board_size(self.board)
        needs = max(across, 0.13) + 2 * _MARGIN, down + 2 * _MARGIN + _FOOT
        for paper in PAPERS.values() if self.paper is None else [_paper_size(self.paper)]:
            for size in (paper, paper[::-1]):
                if needs[0] <= size[0] and needs[1] <= size[1]:
                    return size
        raise InputError(
            f"a board of {across * 1e3:.0f} x {down * 1e3:.0f} mm needs {needs[0] * 1e3:.0f} x {needs[1] * 1e3:.0f} mm "
            f"with its ruler, and does not fit {self.paper or 'A0'}; choose larger paper or smaller squares"
        )

    def _ink(self) -> npt.NDArray[np.float64]:
        """All rectangles of the sheet: board and ruler."""
        width, height = self.size
        across, down = board_size(self.board)
        above = np.array([(width - across) / 2, (height - _FOOT - down) / 2, 0, 0])
        left, top, thick = 2 * _MARGIN, height - _MARGIN - _FOOT + 0.003, 0.0002
        line = [[left, top, 0.1, thick]]
        ticks = [[left + i * 0.01 - thick / 2, top, thick, 0.004 if i % 5 == 0 else 0.002] for i in range(11)]
        return np.concatenate([dark_rectangles(self.board) + above, line, ticks])

    def _texts(self) -> list[tuple[float, float, str]]:
        """Left end and base line of each line of words."""
        _, height = self.size
        base = height - _MARGIN - 0.0045
        lines = [(2 * _MARGIN, base + i * 0.004, text) for i, text in enumerate(self.words)]
        return [*lines, (2 * _MARGIN + 0.102, base - 0.005, "100 mm")]

    def _pdf(self) -> bytes:
        width, height = (side / _POINT for side in self.size)
        boxes = self._ink() / _POINT
        boxes[:, 1] = height - boxes[:, 1] - boxes[:, 3]  # rows go upwards
        # one path, so that no seams show between modules
        drawn = "\n".join(f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in boxes)
        text = "\n".join(
            f"BT /F {_TEXT / _POINT:.2f} Tf {x / _POINT:.2f} {height - y / _POINT:.2f} Td ({words}) Tj ET"
            for x, y, words in self._texts()
        )
        stream = zlib.compress(f"0 g\n{drawn}\nf\n{text}\n".encode("ascii"))
        objects = [
            # viewers are asked not to fit it to the page
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
            f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode() + stream + b"\nendstream",
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
        content, places = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n", []
        for number, one in enumerate(objects, 1):
            places.append(len(content))
            content += f"{number} 0 obj\n".encode() + one + b"\nendobj\n"
        table = "".join(f"{place:010d} 00000 n \n" for place in places)
        count = len(objects) + 1
        end = f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R >>\n"
        return content + end.encode() + f"startxref\n{len(content)}\n%%EOF\n".encode()

    def _png(self, dpi: int) -> bytes:
        per_metre = dpi / 0.0254
        width, height = self.size
        image = draw_rectangles(self._ink(), per_metre, (round(height * per_metre), round(width * per_metre)))
        for x, y, words in self._texts():
            place = round(x * per_metre), round(y * per_metre)
            scale = _TEXT * per_metre / 30
            cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 0, max(1, round(scale * 2)), cv2.LINE_AA)
        encoded = cv2.imencode(".png", image)[1].tobytes()
        # the resolution: after the header, which ends at byte 33
        dots = round(per_metre)
        chunk = b"pHYs" + dots.to_bytes(4, "big") * 2 + b"\x01"
        resolution = (9).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        return encoded[:33] + resolution + encoded[33:]


def _paper_size(paper: str) -> tuple[float, float]:
    if paper.lower() in PAPERS:
        return PAPERS[paper.lower()]
    sides = re.fullmatch(r"(\d+(?:\.\d+)?)\s*x\s*(\d+(?:\.\d+)?)\s*mm", paper.lower())
    if sides is None or not all(0.05 <= float(side) / 1e3 <= 5 for side in sides.groups()):
        raise InputError(f"unknown paper {paper[:40]!r}; expected {', '.join(PAPERS)}, or a size such as '600x400mm'")
    width, height = (float(side) / 1e3 for side in sides.groups())
    return width, height
