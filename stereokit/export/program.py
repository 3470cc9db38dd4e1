"""Networks as programs of `torch.export`."""

import os
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from stereokit.backends.exported import ExportedBackend
from stereokit.backends.metadata import KEY, ExportMetadata, describe_network
from stereokit.export.checking import Pair, check_exact, check_pairs, check_size, compare
from stereokit.export.graph import trace
from stereokit.export.report import ExportReport
from stereokit.export.target import check_target, on_cpu
from stereokit.files import atomic_path

__all__ = ["export_program"]


class _Program(ExportedBackend):
    """A program read back from its file, to be checked."""

    name = "program"
    precision = "float32"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path, torch.device("cpu"))
        extra = {KEY: ""}
        self._module = torch.export.load(path, extra_files=extra).module()
        self.metadata = ExportMetadata.read(extra, self.path)

    @torch.inference_mode()
    def run(self, left: npt.NDArray[np.float32], right: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
        """One pair through the program."""
        return [x.numpy() for x in self._module(torch.from_numpy(left), torch.from_numpy(right))]


def export_program(
    model: nn.Module,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    overwrite: bool = False,
    pairs: Mapping[str, Pair] | None = None,
) -> ExportReport:
    """Writes a network as a program of `torch.export` and checks it against the network.

    `torch.export.load(path).module()` runs it, and AOTInductor compiles it, without stereokit. Inputs and outputs are
    those of `export_onnx`; what the file holds is its extra file "stereokit", see `ExportMetadata`.

    Args:
        model: any module with `forward(left, right) -> StereoOutput`.
        path: ends in .pt2.
        size: height and width that the file is for; None for any from 32 x 32 up.
        overwrite: replace an existing file.
        pairs: images (1, 3, H, W) to compare on besides random textures, by name.

    Raises:
        ConfigError: an operator of the network can't be exported, or the program does not give what the network gives;
            then none is written.
        InputError: the size is too small, or the file can't be written.

    >>> from stereokit import build_model
    >>> export_program(build_model("coex"), "coex.pt2", size=(384, 1248))  # doctest: +SKIP
    """
    target = check_target(path, ".pt2", overwrite=overwrite)
    check_size((pairs or {}).values(), size, "to compare on")
    with on_cpu(model) as network:
        metadata = ExportMetadata(**describe_network(network), size=size)
        program = trace(network, size)
        with atomic_path(target, overwrite=overwrite) as temporary:
            torch.export.save(program, temporary, extra_files={KEY: metadata.to_json()})
            backend = _Program(temporary)
            differences = compare(backend, network, [*check_pairs(network, size), *(pairs or {}).items()])
            check_exact(differences)
    return ExportReport(target, backend.metadata, tuple(differences), backend.precision)
