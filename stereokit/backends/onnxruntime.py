"""ONNX Runtime."""

from os import PathLike
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
import torch

from stereokit.backends.exported import ExportedBackend
from stereokit.backends.metadata import ExportMetadata
from stereokit.errors import CheckpointError, ConfigError, printable
from stereokit.runtime.optional import import_optional

__all__ = ["OnnxRuntimeBackend"]

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}


class OnnxRuntimeBackend(ExportedBackend):
    """An ONNX file in ONNX Runtime, with as many threads as PyTorch has.

    Args:
        path: of a file that `export_onnx` wrote.
        device: "auto" (a GPU if ONNX Runtime can use one), "cpu" or "cuda".
        precision: that of the file, or None.

    Raises:
        ConfigError: ONNX Runtime is not installed or can't use the device, or the file has another precision.
        CheckpointError: the file can't be read, was not written by stereokit, or by a newer version.
    """

    name = "onnxruntime"
    # by benchmarks/memory.py 0.4 to 0.6 for CoEx, 0.9 to 1.0 for PSMNet, 1.1 to 1.4 for GC-Net
    memory_share = 1.5
    memory_shares = MappingProxyType({"hourglass": 0.7, "stacked_hourglass": 1.1})

    def __init__(
        self, path: str | PathLike[str], device: str | torch.device = "auto", precision: str | None = None
    ) -> None:
        runtime = import_optional("onnxruntime", "backend 'onnxruntime'")
        super().__init__(path, self._choose(device, runtime.get_available_providers()))
        options = runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        # errors are raised as well
        options.log_severity_level = 4
        provider: object = PROVIDERS[self.device.type]
        if self.device.type == "cuda":
            provider = (provider, {"device_id": self.device.index or 0})
        try:
            self._session = runtime.InferenceSession(self.path, options, providers=[provider])
        except Exception as error:
            # ONNX Runtime has a family of its own for a file that is missing, damaged or too new
            reason = str(error).strip().splitlines()[0]
            raise CheckpointError(f"{self.path!r} can't be read by ONNX Runtime: {reason}") from error
        # where it can't load what a device needs it goes on with the CPU, and says so in its log alone
        if PROVIDERS[self.device.type] not in self._session.get_providers():
            raise ConfigError(
                f"ONNX Runtime can't use device {str(self.device)!r} here, though built for it: its libraries do "
                "not load; use device 'cpu'"
            )
        self._session.disable_fallback()
        self.metadata = ExportMetadata.read(self._session.get_modelmeta().custom_metadata_map, self.path)
        self.precision = self.metadata.precision
        if precision not in (None, self.precision):
            raise ConfigError(f"{self.path!r} computes in {self.precision}, not {precision}; leave out the precision")

    def run(self, left: npt.NDArray[np.float32], right: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
        """One pair through the file."""
        try:
            maps: list[npt.NDArray[np.float32]] = self._session.run(None, {"left": left, "right": right})
        except Exception as error:
            # its errors have a family of their own, and one class for nearly all
            if any(words in str(error) for words in ("Failed to allocate memory", "bad_alloc", "out of memory")):
                raise MemoryError(str(error)) from error
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise CheckpointError(
                f"{printable(self.path)} fails in ONNX Runtime with images {left.shape}: {reason}; if the file is "
                "damaged, export it again"
            ) from error
        return maps

    @staticmethod
    def _choose(device: str | torch.device, available: list[str]) -> torch.device:
        usable = [kind for kind, provider in PROVIDERS.items() if provider in available]
        if device == "auto":
            return torch.device("cuda" if "cuda" in usable and torch.cuda.is_available() else "cpu")
        try:
            chosen = torch.device(device)
        except (RuntimeError, TypeError):
            chosen = None
        if chosen is None or chosen.type not in usable:
            raise ConfigError(
                f"backend 'onnxruntime' can't use device {str(device)!r} here; "
                f"use {' or '.join(map(repr, ('auto', *usable)))}"
            )
        return chosen
