"""Every registered network, held to its entry in `cases.py`."""

import json
import math

import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, InputError, StereoNetwork, build_model, list_models, load_published
from stereokit.backends import open_backend
from stereokit.export import export_onnx, export_openvino, export_program
from stereokit.inference import match_tiles
from stereokit.losses import named_loss, stereo_loss
from stereokit.optimize import prepare_for_inference
from stereokit.runtime.memory import PeakMemory, estimate_memory
from stereokit.weights.key_map import PUBLISHED
from tests.golden import published_state, recording, save_checkpoint
from tests.models.cases import CASES, QUICK, Case, Golden, captured
from tests.optimize.networks import with_statistics
from tests.shared import needs_shared

OURS = [name for name in list_models() if name in CASES or build_model(name).__module__.startswith("stereokit.")]
RECORDED = [name for name, case in CASES.items() if isinstance(case.golden, Golden)]

every_network = pytest.mark.parametrize("name", OURS)
every_network_in_time = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in OURS]
)
recorded = pytest.mark.parametrize("name", RECORDED)


def small(name: str) -> StereoNetwork:
    """The network, with few disparities."""
    return build_model(name, max_disparity=CASES[name].max_disparity, **CASES[name].overrides)


def pair(case: Case, *, batch: int = 1, less: tuple[int, int] = (0, 0), dtype: torch.dtype = torch.float32):
    height, width = case.size
    scene = torch.rand(batch, 3, height - less[0], width - less[1] + 5, dtype=dtype)
    return scene[..., 5:].contiguous(), scene[..., :-5].contiguous()


def test_every_network_has_an_entry():
    assert set(OURS) == set(CASES)
    for case in CASES.values():
        assert isinstance(case.golden, Golden) or case.golden
        assert bool(case.no_export) == (len(case.exports) < 3)


@every_network
def test_it_has_the_published_size(name):
    case = CASES[name]
    with torch.device("meta"):
        assert sum(p.numel() for p in build_model(name).parameters()) == case.parameters


@every_network_in_time
def test_what_training_alone_uses_is_as_published(name):
    case = CASES[name]
    if not case.training_only:
        return
    model, called = small(name).eval(), set()
    for module in model.modules():
        module.register_forward_hook(lambda module, _inputs, _output: called.add(module))
    model(*pair(case)).disparity.sum().backward()
    # no gradient goes from one stage to the one before, and a module may be read without being called
    called = {id(p) for module in called for p in module.parameters(recurse=False)}
    unread = sum(p.numel() for p in model.parameters() if p.grad is None and id(p) not in called)
    assert unread == case.training_only


@every_network
def test_its_configuration_is_plain_and_rebuilds_it(name):
    with torch.device("meta"):
        model = build_model(name)
        config = json.loads(json.dumps(model.config))
        again = build_model(config)
    assert again.config == model.config == config
    assert {k: v.shape for k, v in again.state_dict().items()} == {k: v.shape for k, v in model.state_dict().items()}


@every_network_in_time
def test_odd_sizes_are_padded_and_cut(name):
    case, model = CASES[name], small(name).eval()
    less = (0, 0) if min(case.size) == model.least_size else (9, 17)
    left, right = pair(case, less=less)
    with torch.inference_mode():
        output = model(left, right)
    assert output.disparity.shape == left[:, 0].shape
    assert output.disparity.isfinite().all()
    if output.confidence is not None:
        assert output.confidence.shape == left[:, 0].shape
        assert ((output.confidence >= 0) & (output.confidence <= 1)).all()
    assert output.predictions == ()


@every_network_in_time
def test_a_batch_of_two_is_two_batches_of_one(name):
    case, model = CASES[name], small(name).eval().double()
    left, right = pair(case, batch=2, dtype=torch.float64)
    with torch.inference_mode():
        both = model(left, right).disparity
        for i in range(2):
            assert_close(both[i : i + 1], model(left[i : i + 1], right[i : i + 1]).disparity)


@every_network_in_time
def test_one_step_of_training_reaches_each_weight(name):
    case, model = CASES[name], small(name).train()
    left, right = pair(case, batch=2)
    output = model(left, right)
    assert len(output.predictions) == len(model.loss_weights)
    truth = torch.full_like(left[:, 0], 5.0)
    loss = stereo_loss(
        output, truth, auxiliary_weights=model.auxiliary_weights, loss=named_loss(case.loss), max_disparity=64
    )
    loss.backward()
    assert loss.isfinite()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    assert all(p.grad.isfinite().all() for p in model.parameters())


@every_network_in_time
def test_no_known_pixel_is_a_loss_of_zero_with_a_gradient(name):
    case, model = CASES[name], small(name).train()
    left, right = pair(case, batch=2)
    truth = torch.full_like(left[:, 0], math.nan)
    loss = stereo_loss(model(left, right), truth, auxiliary_weights=model.auxiliary_weights, loss=named_loss(case.loss))
    loss.backward()
    assert loss.item() == 0
    assert all((p.grad == 0).all() for p in model.parameters() if p.grad is not None)


@every_network_in_time
def test_it_is_saved_and_loaded(name, tmp_path):
    case, model = CASES[name], small(name).eval()
    model.save_pretrained(tmp_path)
    again = StereoNetwork.from_pretrained(tmp_path)
    images = pair(case)
    with torch.inference_mode():
        assert_close(again(*images).disparity, model(*images).disparity, rtol=0, atol=0)


@every_network_in_time
def test_what_is_prepared_for_inference_equals_it(name):
    images = pair(CASES[name])
    model = with_statistics(small(name), images)
    with torch.inference_mode():
        expected, given = model(*images).disparity, prepare_for_inference(model, example=images)(*images).disparity
    # rounding decides between candidates that tie, and random weights make it larger
    assert ((given - expected).abs() < CASES[name].rounding).float().mean() > 0.98


@pytest.mark.slow
@every_network
def test_compile_captures_one_graph_that_agrees(name):
    images = pair(CASES[name])
    model = with_statistics(small(name), images)
    try:
        with torch.inference_mode():
            compiled = torch.compile(model, backend="aot_eager", fullgraph=True)
            apart = (compiled(*images).disparity - model(*images).disparity).abs()
    finally:
        torch.compiler.reset()
    assert (apart < 0.01).float().mean() > 0.98


@pytest.mark.slow
@every_network
@pytest.mark.parametrize("fixed", [True, False])
def test_it_is_exported_and_checked(name, fixed, tmp_path, monkeypatch):
    # candidates around a prediction make the rounding of random weights larger
    monkeypatch.setattr("stereokit.export.checking.TOLERANCE", CASES[name].rounding)
    case = CASES[name]
    model = with_statistics(small(name), pair(case))
    size = case.size if fixed else None
    for format in case.exports:
        if format == "onnx":
            report = export_onnx(model, tmp_path / "network.onnx", size=size)
            backend = open_backend(report.path, "cpu")
            assert backend(*pair(case)).disparity.shape == (1, *case.size)
        elif format == "openvino":
            export_openvino(model, tmp_path / "network.xml", size=size)
        else:
            export_program(model, tmp_path / "network.pt2", size=size)


@pytest.mark.slow
@every_network
def test_its_memory_is_below_the_estimate(name):
    case, model = CASES[name], small(name).eval()
    height, width = (4 * side for side in case.size)
    left, right = torch.rand(2, 1, 3, height, width)
    with torch.inference_mode():
        # what is made once, such as the threads of the convolutions
        model(left, right)
        peak = PeakMemory("cpu")
        model(left, right)
        taken = peak.bytes()
    if taken is None:
        pytest.skip("this system does not tell")
    # of small pairs what the allocator and the libraries hold for themselves weighs more: gaps where copies of weights
    # lay, too
    weights = sum(p.numel() * p.element_size() for p in model.parameters())
    assert taken < 1.5 * estimate_memory(model, height, width) + 100e6 + weights


@pytest.mark.slow
@every_network
def test_tiles_make_a_small_seam(name):
    case, model = CASES[name], small(name).eval()
    height, width = max(case.size[0], 64), 8 * case.size[1]
    left, right = torch.rand(2, 1, 3, height, width)
    with torch.inference_mode():
        whole = model(left, right).disparity
        tiles = match_tiles(
            model, left, right, tile=(height, width * 5 // 8), max_disparity=case.max_disparity, multiple=model.multiple
        ).disparity
    # random weights may give thousands of px
    scale = max(1.0, whole.std().item() / case.max_disparity)
    assert (tiles - whole).abs().mean() < scale * case.seam


@needs_shared
@pytest.mark.slow
@recorded
def test_it_computes_what_the_published_network_did(name, tmp_path):
    golden = CASES[name].golden
    state = published_state(golden.name, golden.norm, seed=golden.seed)
    path = save_checkpoint(state, tmp_path / "published.ckpt")
    model = load_published(path, name, "rgb", **golden.overrides)
    recorded = recording(golden.name)
    output = None

    def run() -> None:
        nonlocal output
        with torch.inference_mode():
            output = model(recorded["left"], recorded["right"])

    for tap, value in captured(model, golden.taps, run).items():
        expected = recorded[tap].reshape(value.shape)
        assert (value - expected).abs().max() < golden.logits * expected.std(), tap
    expected = golden.sign * recorded[golden.disparity].reshape(output.disparity.shape)
    assert ((output.disparity - expected).abs() < 0.01).float().mean() >= golden.pixels


@needs_shared
@recorded
def test_every_published_key_has_a_place(name):
    golden = CASES[name].golden
    state = published_state(golden.name, golden.norm, seed=golden.seed)
    assert any(not published.left_over(state) for published in PUBLISHED if published.network == name)


@needs_shared
@pytest.mark.slow
@recorded
def test_a_published_checkpoint_is_recognised(name, tmp_path):
    golden = CASES[name].golden
    path = save_checkpoint(published_state(golden.name, golden.norm, seed=golden.seed), tmp_path / "published.ckpt")
    assert load_published(path).config["name"] == name


@every_network_in_time
def test_images_below_the_least_size_are_refused(name):
    model = small(name)
    side = model.least_size - 1
    with pytest.raises(InputError, match=f"at least {model.least_size} x {model.least_size}"):
        model(*torch.rand(2, 1, 3, side, side))


@every_network
def test_arguments_that_it_does_not_have_are_refused(name):
    with pytest.raises(ConfigError, match="no argument 'max_disparitee'"):
        build_model(name, max_disparitee=64)
