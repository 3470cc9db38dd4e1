"""Networks as files for other runtimes: ONNX, OpenVINO, and programs of `torch.export`."""

from stereokit.backends.metadata import ExportMetadata
from stereokit.export.onnx import export_onnx
from stereokit.export.openvino import export_openvino
from stereokit.export.program import export_program
from stereokit.export.report import ExportReport

__all__ = ["ExportMetadata", "ExportReport", "export_onnx", "export_openvino", "export_program"]
