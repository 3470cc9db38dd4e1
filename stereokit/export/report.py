"""What an export gives back."""

from dataclasses import dataclass
from pathlib import Path

from stereokit.backends.metadata import ExportMetadata
from stereokit.export.checking import Difference
from stereokit.tables import counted

__all__ = ["ExportReport"]


FEW = 20
"""Pairs of a calibration below which the report says so."""


@dataclass(frozen=True)
class ExportReport:
    """A file that was written and checked.

    Args:
        path: of the file.
        metadata: that it holds.
        differences: from the network in float32, pair by pair.
        precision: in which the check ran; wider than that of the file where this machine lacks it.
        calibrated_on: pairs that ranges of values were measured on; None without a calibration.
    """

    path: Path
    metadata: ExportMetadata
    differences: tuple[Difference, ...]
    precision: str
    calibrated_on: int | None = None

    def __str__(self) -> str:
        size = self.metadata.size
        of = "images of any size" if size is None else f"{size[1]} x {size[0]} px"
        opset = "" if self.metadata.opset is None else f", opset {self.metadata.opset}"
        lines = [f"wrote {self.path}: {of}, {self.metadata.precision}{opset}"]
        if self.calibrated_on is not None:
            few = "; 20 to 300 are usual" if self.calibrated_on < FEW else ""
            lines.append(f"calibrated on {counted(self.calibrated_on, 'pair')}{few}")
        if self.precision != self.metadata.precision:
            lines.append(f"this machine has no {self.metadata.precision}; compared with PyTorch in {self.precision}:")
        else:
            lines.append("compared with PyTorch in float32:")
        return "\n".join([*lines, *(f"  {difference}" for difference in self.differences)])
