"""The same disparities on every device, through every backend of torch and in every precision."""

import numpy as np
import pytest
import torch

from stereokit import Predictor, build_model, list_models
from stereokit.data.synthetic import SyntheticScenes
from tests.models.cases import CASES, QUICK

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA")
# in px, at nine of ten pixels
TOLERANCE = {"float32": 0.02, "float16": 0.1, "bfloat16": 0.3}


@pytest.fixture(scope="module")
def scene():
    return SyntheticScenes(seed=5, size=(96, 192), max_disparity=48, count=1)[0]


@pytest.fixture(scope="module")
def expected(scene):
    """Of the plain network, on the CPU."""
    left, right = (torch.from_numpy(image).permute(2, 0, 1).unsqueeze(0) for image in (scene.left, scene.right))
    with torch.inference_mode():
        return build_model("coex", pretrained=True)(left, right).disparity[0].numpy()


@pytest.mark.parametrize("backend", ["torch", pytest.param("compile", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("device", "precision"),
    # not every CPU has instructions for half precision
    [("cpu", "float32"), *(pytest.param("cuda", precision, marks=needs_cuda) for precision in TOLERANCE)],
)
def test_disparities_are_those_of_the_plain_network(scene, expected, device, backend, precision):
    predict = Predictor("coex", device, backend, precision=precision)
    first = predict(scene.left, scene.right)
    before = first.disparity.copy()
    assert np.quantile(np.abs(first.disparity - expected), 0.9) < TOLERANCE[precision]
    # another pair, and another size: what was given out stays, though graphs on a GPU reuse their memory
    predict(scene.right, scene.left)
    assert predict(scene.left[:80, :170], scene.right[:80, :170]).disparity.shape == (80, 170)
    np.testing.assert_array_equal(first.disparity, before)
    again = predict(scene.left, scene.right).disparity
    assert np.quantile(np.abs(again - expected), 0.9) < TOLERANCE[precision]


@pytest.mark.parametrize(
    ("name", "device"),
    [
        *(pytest.param(name, "cpu", marks=() if name in QUICK else pytest.mark.slow) for name in list_models()),
        *(pytest.param(name, "cuda", marks=needs_cuda) for name in list_models()),
    ],
)
def test_every_network_learns_on_every_device(name, device):
    torch.manual_seed(0)
    case = CASES[name]
    model = build_model(name, max_disparity=case.max_disparity, **case.overrides).to(device).train()
    left, right = torch.rand(2, 2, 3, *case.size, device=device)
    output = model(left, right)
    assert output.disparity.device.type == torch.device(device).type
    sum(disparity.mean() for disparity in (output.disparity, *output.auxiliary)).backward()
    gradients = [parameter.grad for parameter in model.parameters() if parameter.requires_grad]
    assert any(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)
    assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)
