"""Which operations of an OpenVINO graph compute in 8 bits, and their quantisation."""

import logging
from collections.abc import Sequence
from typing import Any

from stereokit.export.checking import Pair
from stereokit.layers.casting import as_float
from stereokit.runtime.optional import import_optional

__all__ = ["outside_convolutions", "quantize"]

PRODUCTS = {
    "Convolution",
    "ConvolutionBackpropData",
    "GroupConvolution",
    "GroupConvolutionBackpropData",
    "MatMul",
}
"""What 8 bits make fast."""


def quantize(graph: Any, calibration: Sequence[Pair]) -> Any:
    """An OpenVINO graph with convolutions and matrix products in 8 bits, by NNCF.

    What comes before the first and after the last of them keeps its precision: 8 bits of a disparity are steps of
    0.3 px up to the largest one that the calibration happened to have, and nothing above it.

    Args:
        graph: an `openvino.Model` with the inputs "left" and "right".
        calibration: images (1, 3, H, W), uint8, or floating-point in [0, 1].
    """
    nncf = import_optional("nncf", "int8")
    samples = [
        {name: as_float(image).float().numpy() for name, image in zip(("left", "right"), pair, strict=True)}
        for pair in calibration
    ]
    # a line for each operation that is left out
    logging.getLogger("nncf").setLevel(logging.WARNING)
    scope = nncf.IgnoredScope(names=outside_convolutions(graph), validate=False)
    return nncf.quantize(graph, nncf.Dataset(samples), subset_size=len(samples), ignored_scope=scope)


def outside_convolutions(graph: Any) -> list[str]:
    """The operations of an OpenVINO graph that lie before all convolutions and matrix products, or after all."""
    operations = graph.get_ordered_ops()
    after: set[str] = set()
    for operation in operations:
        givers = [port.get_source_output().get_node() for port in operation.inputs()]
        _pass_on(operation, givers, after)
    before: set[str] = set()
    for operation in reversed(operations):
        takers = [port.get_node() for output in operation.outputs() for port in output.get_target_inputs()]
        _pass_on(operation, takers, before)
    names = (operation.get_friendly_name() for operation in operations if operation.get_type_name() != "Constant")
    return [name for name in names if name not in after & before]


def _pass_on(operation: Any, neighbors: Sequence[Any], reached: set[str]) -> None:
    """Adds an operation that is a product, or next to one that was reached."""
    if operation.get_type_name() in PRODUCTS or any(n.get_friendly_name() in reached for n in neighbors):
        reached.add(operation.get_friendly_name())
