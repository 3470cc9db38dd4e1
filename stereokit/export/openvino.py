"""Networks as OpenVINO files."""

import dataclasses
import io
import os
from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from stereokit.backends.metadata import KEY, ExportMetadata
from stereokit.backends.openvino import OpenVinoBackend
from stereokit.backends.signal_stack import kept_signal_stack
from stereokit.errors import ConfigError
from stereokit.export.checking import Pair, check_exact, check_pairs, check_size, compare
from stereokit.export.onnx import check_onnx, to_onnx
from stereokit.export.quantization import quantize
from stereokit.export.report import ExportReport
from stereokit.export.target import check_target, on_cpu
from stereokit.files import atomic_path
from stereokit.runtime.optional import import_optional

__all__ = ["PRECISIONS", "export_openvino"]

PRECISIONS = ("float32", "bfloat16", "int8")

OPSET = 18
"""Of the ONNX graph on the way, whose every operator OpenVINO reads; it can't read all of torch.export's."""


def export_openvino(
    model: nn.Module,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    precision: str = "float32",
    calibration: Sequence[Pair] | None = None,
    overwrite: bool = False,
    pairs: Mapping[str, Pair] | None = None,
) -> ExportReport:
    """Writes a network as an OpenVINO file (.xml, with its weights in .bin) and checks it against PyTorch.

    Inputs and outputs are those of `export_onnx`; what the file holds is its runtime information "stereokit", see
    `ExportMetadata`.

    Args:
        model: any module with `forward(left, right) -> StereoOutput`.
        path: ends in .xml.
        size: height and width that the file is for; None for any from 32 x 32 up.
        precision: "float32"; "bfloat16", which keeps the weights and asks OpenVINO to compute so where the machine can;
            or "int8": convolutions and matrix products quantised after training by NNCF.
        calibration: images (1, 3, H, W) like those to come, which "int8" measures the ranges of values on; 20 to 300
            pairs are usual.
        overwrite: replace existing files.
        pairs: images (1, 3, H, W) to compare on, by name, besides random textures; the report says how far a lower
            precision is off on them. By default "int8" is compared on the first pairs of the calibration.

    Raises:
        ConfigError: the packages of the extra "openvino" are missing, "int8" without calibration, an operator of the
            network can't be exported, or a float32 file does not give what the network gives; then none is written.
        InputError: the size is too small, calibration of another size, or the files can't be written.

    >>> from stereokit import build_model
    >>> export_openvino(build_model("coex"), "coex.xml", precision="bfloat16")  # doctest: +SKIP
    """
    target = check_target(path, ".xml", overwrite=overwrite)
    weights = check_target(target.with_suffix(".bin"), ".bin", overwrite=overwrite)
    if precision not in PRECISIONS:
        raise ConfigError(f"precision {precision!r} can't be exported; use {', '.join(PRECISIONS)}")
    _check_calibration(precision, calibration, size)
    check_size((pairs or {}).values(), size, "to compare on")
    openvino = import_optional("openvino", "export to OpenVINO")
    if precision == "int8":
        import_optional("nncf", "int8")
    check_onnx()
    with on_cpu(model) as network:
        converted = _convert(openvino, network, size, precision)
        chosen = [*check_pairs(network, size), *(pairs or {}).items()]
        if calibration is not None:
            converted = quantize(converted, calibration)
            # a random texture is unlike what the ranges were measured on
            default = {f"calibration pair {i}": pair for i, pair in enumerate(calibration[:4])}
            chosen = list((pairs or default).items())
        # the weights are in place before the graph that reads them
        with atomic_path(target, overwrite=overwrite) as xml, atomic_path(weights, overwrite=overwrite) as binary:
            openvino.serialize(converted, str(xml), str(binary))
            if precision != "int8":
                exact = compare(OpenVinoBackend(xml, "cpu", "float32", weights=binary), network, chosen)
                check_exact(exact)
            backend = OpenVinoBackend(xml, "cpu", weights=binary)
            differences = compare(backend, network, chosen)
            # a graph of before must not read the weights of now, should the process end between the two
            target.unlink(missing_ok=True)
    return ExportReport(
        target,
        backend.metadata,
        tuple(differences),
        backend.precision,
        calibrated_on=None if calibration is None else len(calibration),
    )


def _check_calibration(precision: str, calibration: Sequence[Pair] | None, size: tuple[int, int] | None) -> None:
    if precision != "int8":
        if calibration is not None:
            raise ConfigError(f"calibration is for precision 'int8' alone; leave it out for {precision!r}")
        return
    if not calibration:
        raise ConfigError(
            "int8 needs pairs of images to measure the ranges of values on; give some like those to come "
            "(calibration=[(left, right), ...]; --calibrate LEFT RIGHT, or a data set), or rendered ones "
            "(--calibrate synthetic)"
        )
    check_size(calibration, size, "of the calibration")


@kept_signal_stack()
def _convert(openvino: Any, network: nn.Module, size: tuple[int, int] | None, precision: str) -> Any:
    """By way of ONNX: OpenVINO's own reader of programs lacks what the correlation and dynamic pooling need."""
    proto = to_onnx(network, size, OPSET)
    [stored] = [entry.value for entry in proto.metadata_props if entry.key == KEY]
    metadata = dataclasses.replace(ExportMetadata.read({KEY: stored}, "the graph"), precision=precision, opset=None)
    converted = openvino.convert_model(io.BytesIO(proto.SerializeToString()))
    converted.set_rt_info(metadata.to_json(), KEY)
    return converted
