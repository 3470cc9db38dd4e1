import numpy as np
import pytest

from stereokit.export.quantization import outside_convolutions

openvino = pytest.importorskip("openvino")


def test_what_lies_before_and_after_all_products_is_outside():
    ops = openvino.opset13
    image = ops.parameter([1, 1, 4, 4], name="image")
    normalised = ops.multiply(image, np.float32(2), name="normalised")
    weight = np.ones((1, 1, 1, 1), np.float32)

    def convolution(x, name):
        return ops.convolution(x, weight, [1, 1], [0, 0], [0, 0], [1, 1], name=name)

    first = convolution(normalised, "first")
    between = ops.relu(first, name="between")
    # reads what lies between, but no product reads it
    guide = ops.sigmoid(between, name="guide")
    second = convolution(between, "second")
    disparity = ops.add(ops.exp(second, name="regression"), guide, name="disparity")
    result = ops.result(disparity, name="result")
    graph = openvino.Model([result], [image])
    outside = {"image", "normalised", "guide", "regression", "disparity", "result"}
    assert set(outside_convolutions(graph)) == outside
