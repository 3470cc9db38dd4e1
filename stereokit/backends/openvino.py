"""OpenVINO."""

from os import PathLike, fspath
from threading import Lock

import numpy as np
import numpy.typing as npt
import torch

from stereokit.backends.exported import ExportedBackend
from stereokit.backends.metadata import KEY, ExportMetadata
from stereokit.backends.signal_stack import kept_signal_stack
from stereokit.errors import CheckpointError, ConfigError, printable
from stereokit.runtime.optional import import_optional

__all__ = ["OpenVinoBackend"]

DEVICES = {"cpu": "CPU", "xpu": "GPU"}
HINTS = {"float32": "f32", "bfloat16": "bf16", "float16": "f16"}


class OpenVinoBackend(ExportedBackend):
    """An OpenVINO file, on as many threads of the CPU as PyTorch has, or on an Intel GPU.

    Args:
        path: of the .xml file that `export_openvino` wrote; its .bin lies beside it.
        device: "auto" and "cpu" mean the CPU, "xpu" an Intel GPU.
        precision: "float32", "bfloat16" or "float16" for the arithmetic of a file with floating-point weights; what
            the file was exported for by default. Where the device lacks it, OpenVINO takes a wider one, and the
            attribute `precision` says so.
        weights: the .bin file, where it lies elsewhere.

    Raises:
        ConfigError: OpenVINO is not installed or can't use the device or the precision.
        CheckpointError: the file can't be read, was not written by stereokit, or by a newer version.
    """

    name = "openvino"
    # 1.0 to 1.5 by benchmarks/memory.py
    memory_share = 1.6

    @kept_signal_stack()
    def __init__(
        self,
        path: str | PathLike[str],
        device: str | torch.device = "auto",
        precision: str | None = None,
        *,
        weights: str | PathLike[str] | None = None,
    ) -> None:
        openvino = import_optional("openvino", "backend 'openvino'")
        core = openvino.Core()
        usable = [kind for kind, name in DEVICES.items() if any(d.startswith(name) for d in core.available_devices)]
        kind = "cpu" if device == "auto" else str(device)
        if kind not in usable:
            raise ConfigError(
                f"backend 'openvino' can't use device {kind!r} here; use {' or '.join(map(repr, ('auto', *usable)))}"
            )
        super().__init__(path, torch.device(kind))
        try:
            model = core.read_model(self.path, "" if weights is None else fspath(weights))
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise CheckpointError(f"{self.path!r} can't be read by OpenVINO: {reason}") from error
        properties = {KEY: model.get_rt_info(KEY).astype(str)} if model.has_rt_info(KEY) else {}
        self.metadata = ExportMetadata.read(properties, self.path)
        wanted = precision or self.metadata.precision
        quantised = self.metadata.precision == "int8"
        if (quantised and wanted != "int8") or (not quantised and wanted not in HINTS):
            would_do = "'int8'" if quantised else ", ".join(map(repr, HINTS))
            raise ConfigError(f"{self.path!r} can't compute in {wanted}; use {would_do}")
        # what is left of an int8 file in floating point stays single; without a hint OpenVINO chooses by itself
        settings: dict[str, object] = {"INFERENCE_PRECISION_HINT": HINTS.get(wanted, "f32")}
        if kind == "cpu":
            settings["INFERENCE_NUM_THREADS"] = torch.get_num_threads()
        self._compiled = core.compile_model(model, DEVICES[kind], settings)
        # a compiled model has one place for its results
        self._alone = Lock()
        hint = self._compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        self.precision = wanted if quantised else next(p for p, h in HINTS.items() if h == hint)

    @kept_signal_stack()
    def run(self, left: npt.NDArray[np.float32], right: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
        """One pair through the file."""
        with self._alone:
            try:
                maps = self._compiled({"left": left, "right": right})
            except RuntimeError as error:
                reason = next(iter(str(error).strip().splitlines()[::-1]), type(error).__name__)
                if "out of memory" in reason.lower() or "bad_alloc" in reason:
                    raise MemoryError(reason) from error
                raise CheckpointError(
                    f"{printable(self.path)} fails in OpenVINO with images {left.shape}: {reason}; if the file is "
                    "damaged, export it again"
                ) from error
            # copies: the next pair is written into the same memory
            return [np.array(maps[output]) for output in self._compiled.outputs]
