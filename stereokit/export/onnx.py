"""Networks as ONNX files."""

import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from stereokit.backends.metadata import KEY, ExportMetadata, describe_network
from stereokit.backends.onnxruntime import OnnxRuntimeBackend
from stereokit.errors import ConfigError
from stereokit.export.checking import Pair, check_exact, check_pairs, check_size, compare
from stereokit.export.graph import ExportGraph, naming_block, trace
from stereokit.export.report import ExportReport
from stereokit.export.target import check_target, on_cpu
from stereokit.files import atomic_path
from stereokit.runtime.optional import import_optional

__all__ = ["OPSETS", "export_onnx", "to_onnx"]

OPSETS = range(18, 24)
"""Of ONNX. 18 is the oldest that PyTorch writes; the runtimes know all of them."""

OUTPUTS = ("disparity", "confidence")


def export_onnx(
    model: nn.Module,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    opset: int = 18,
    overwrite: bool = False,
    pairs: Mapping[str, Pair] | None = None,
) -> ExportReport:
    """Writes a network as an ONNX file and checks it in ONNX Runtime against PyTorch.

    The inputs are "left" and "right", (1, 3, H, W), RGB, float32 in [0, 1]; the outputs "disparity", in pixels, and
    "confidence", (1, H, W). Normalisation and padding are inside. There are no custom operators and no control flow,
    and the k of the top k is a constant. The file says what it holds in its property "stereokit", see `ExportMetadata`.

    Args:
        model: any module with `forward(left, right) -> StereoOutput`.
        path: ends in .onnx.
        size: height and width that the file is for; None for any from 32 x 32 up.
        opset: one of `OPSETS`.
        overwrite: replace an existing file.
        pairs: images (1, 3, H, W) to compare on besides random textures, by name.

    Raises:
        ConfigError: the packages of the extra "onnx" are missing, an operator of the network can't be exported, or the
            file does not give what the network gives; then none is written.
        InputError: the size is too small, or the file can't be written.

    >>> from stereokit import build_model
    >>> export_onnx(build_model("coex"), "coex.onnx", size=(384, 1248))  # doctest: +SKIP
    """
    target = check_target(path, ".onnx", overwrite=overwrite)
    if opset not in OPSETS:
        raise ConfigError(f"opset {opset} can't be written; use {OPSETS[0]} to {OPSETS[-1]}")
    check_size((pairs or {}).values(), size, "to compare on")
    check_onnx()
    import_optional("onnxruntime", "the check of an ONNX file")
    with on_cpu(model) as network:
        proto = to_onnx(network, size, opset)
        with atomic_path(target, overwrite=overwrite) as temporary:
            temporary.write_bytes(proto.SerializeToString())
            backend = OnnxRuntimeBackend(temporary, "cpu")
            chosen = [*check_pairs(network, size), *(pairs or {}).items()]
            differences = compare(backend, network, chosen)
            check_exact(differences)
    return ExportReport(target, backend.metadata, tuple(differences), backend.precision)


def check_onnx() -> None:
    """Raises `ConfigError` where a package is missing that writes ONNX, before the work begins."""
    for package in ("onnx", "onnxscript"):
        import_optional(package, "export to ONNX")


def to_onnx(model: nn.Module, size: tuple[int, int] | None, opset: int) -> Any:
    """A network in eval mode as an `onnx.ModelProto`."""
    program = trace(model, size)
    names = OUTPUTS[: len(program.graph_signature.user_outputs)]
    with naming_block(ExportGraph(model)), torch.no_grad():
        exported = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=opset,
            input_names=["left", "right"],
            output_names=names,
            verbose=False,
        )
    assert exported is not None
    proto = exported.model_proto
    _tidy(proto.graph, size)
    metadata = ExportMetadata(**describe_network(model), size=size, opset=opset)
    entry = proto.metadata_props.add()
    entry.key, entry.value = KEY, metadata.to_json()
    return proto


def _tidy(graph: Any, size: tuple[int, int] | None) -> None:
    """Names the axes, and drops what the tracer says of its own work: guessed shapes, source lines and their paths."""
    del graph.value_info[:]
    for node in graph.node:
        scope = {entry.key: entry.value for entry in node.metadata_props}.get("namespace", "")
        del node.metadata_props[:]
        if scope:
            # the module path, which viewers group nodes by
            node.metadata_props.add(key="namespace", value=scope)
    if size is None:
        for value in (*graph.input, *graph.output):
            *_, height, width = value.type.tensor_type.shape.dim
            height.dim_param, width.dim_param = "height", "width"
