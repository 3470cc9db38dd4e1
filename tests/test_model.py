import copy
import math
import shutil

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import (
    ConfigError,
    CorrelationVolume,
    InputError,
    SoftArgmin,
    StereoModel,
    StereoOutput,
    TopKSoftArgmin,
    build_model,
)
from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import bilinear_upsample
from stereokit.losses import stereo_loss
from stereokit.network import Preprocessing
from stereokit.optimize import prepare_for_training
from stereokit.upsampling.interpolation import BilinearUpsampler, TrilinearUpsampler

D = 64

# further networks are held to `tests/models/cases.py`
every_model = pytest.mark.parametrize("name", ["coex", "psmnet", pytest.param("gcnet", marks=pytest.mark.slow)])


def pair(height, width, *, batch=1, dtype=torch.float32):
    """Noise as images."""
    return torch.rand(2, batch, 3, height, width, dtype=dtype)


def shifted_pair(height, width, shift):
    """A scene whose disparity is the same everywhere."""
    scene = torch.rand(1, 3, height, width + shift)
    return scene[..., :width], scene[..., shift:]


@every_model
@pytest.mark.parametrize(("height", "width"), [(32, 32), (33, 47), (61, 90)])
def test_any_size_works(name, height, width):
    model = build_model(name, max_disparity=D).eval()
    with torch.no_grad():
        output = model(*pair(height, width))
    assert output.disparity.shape == output.confidence.shape == (1, height, width)
    assert output.disparity.dtype == output.confidence.dtype == torch.float32
    assert (output.disparity >= 0).all()
    assert (output.disparity < D).all()
    assert (output.confidence >= 0).all()
    assert (output.confidence <= 1).all()


@every_model
@pytest.mark.parametrize("padding", ["replicate", "zeros"])
def test_images_are_padded_at_the_right_and_at_the_bottom(name, padding):
    model = build_model(name, max_disparity=32, padding=padding).eval().double()
    bottom, right_side = model.multiple - 5, 7
    height, width = 3 * model.multiple - bottom, 3 * model.multiple - right_side
    left, right = pair(height, width, dtype=torch.float64)
    if padding == "replicate":
        padded = [F.pad(image, (0, right_side, 0, bottom), mode="replicate") for image in (left, right)]
    else:
        # zero after normalisation is the mean colour before it
        padded = [model.mean.expand(1, 3, height + bottom, width + right_side).clone() for _ in range(2)]
        for canvas, image in zip(padded, (left, right), strict=True):
            canvas[..., :height, :width] = image
    with torch.no_grad():
        assert_close(model(left, right).disparity, model(*padded).disparity[:, :height, :width])


@every_model
def test_a_batch_of_two_is_two_batches_of_one(name):
    model = build_model(name, max_disparity=D).eval().double()
    left, right = pair(32, 64, batch=2, dtype=torch.float64)
    with torch.no_grad():
        both = model(left, right, return_logits=True)
        for i in range(2):
            one = model(left[i : i + 1], right[i : i + 1], return_logits=True)
            for name in ("disparity", "confidence", "logits"):
                assert_close(getattr(both, name)[i : i + 1], getattr(one, name))


@every_model
def test_uint8_is_float_by_255(name):
    model = build_model(name, max_disparity=32).eval()
    left, right = torch.randint(256, (2, 1, 3, 32, 48), dtype=torch.uint8)
    with torch.no_grad():
        assert_close(model(left, right), model(left / 255, right / 255), rtol=0, atol=0)


@every_model
def test_double_precision_stays(name):
    model = build_model(name, max_disparity=32).eval().double()
    with torch.no_grad():
        output = model(*pair(32, 32, dtype=torch.float64))
    assert output.disparity.dtype == output.confidence.dtype == torch.float64


@every_model
def test_mode_changes_values_but_not_the_type(name):
    model = build_model(name, max_disparity=32)
    images = pair(32, 64)
    trained = model(*images)
    assert isinstance(trained, StereoOutput)
    assert len(trained.auxiliary) == len(model.auxiliary_weights)
    assert all(d.shape == (1, 32, 64) for d in trained.auxiliary)
    assert trained.confidence is None
    assert trained.logits is not None
    model.eval()
    output = model(*images)
    assert isinstance(output, StereoOutput)
    assert output.auxiliary == ()
    assert output.confidence.shape == (1, 32, 64)
    assert output.logits is None


@every_model
def test_logits_come_when_asked_for(name):
    model = build_model(name, max_disparity=32)
    stride = model.stride // model.aggregation.upscale
    for mode in (True, False):
        logits = model.train(mode)(*pair(33, 64), return_logits=True).logits
        padded = math.ceil(33 / model.multiple) * model.multiple
        assert logits.shape == (1, 32 // stride, padded // stride, 64 // stride)


@every_model
def test_a_few_steps_of_training_lower_the_loss(name):
    model = build_model(name, max_disparity=32)
    left, right = shifted_pair(32, 64, 6)
    truth = torch.full((1, 32, 64), 6.0)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    losses = []
    for _ in range(6):
        optimizer.zero_grad()
        output = model(left, right)
        loss = stereo_loss(output, truth, auxiliary_weights=model.auxiliary_weights, max_disparity=32)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


@every_model
@pytest.mark.parametrize("training", [False, True])
def test_bfloat16_autocast_stays_finite(name, training):
    model = prepare_for_training(build_model(name, max_disparity=32)).train(training)
    with torch.autocast("cpu", torch.bfloat16):
        # where a map is a single pixel, a batch of one has no statistics to train with
        output = model(*pair(32, 64 if training else 32))
        disparities = (output.disparity, *output.auxiliary)
        assert all(d.isfinite().all() and d.dtype == torch.float32 for d in disparities)
    sum(d.mean() for d in disparities).backward()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


def assert_agrees(actual, expected):
    """Top-k flips between near ties, so that a few pixels may differ by a level; logits may not."""
    scale = expected.logits.abs().max().item()
    assert_close(actual.logits, expected.logits, rtol=0, atol=1e-3 * scale)
    assert ((actual.disparity - expected.disparity).abs() > 0.01).float().mean() < 0.01
    assert_close(actual.confidence, expected.confidence, rtol=0, atol=1e-3)


def compare_compiled(name, backend):
    model = build_model(name, max_disparity=32).eval()
    images = pair(32, 64)
    try:
        with torch.no_grad():
            compiled = torch.compile(model, backend=backend, fullgraph=True)
            assert_agrees(compiled(*images, return_logits=True), model(*images, return_logits=True))
    finally:
        torch.compiler.reset()


@pytest.mark.slow
@every_model
def test_compile_captures_one_graph_that_agrees(name):
    compare_compiled(name, "aot_eager")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None and shutil.which("g++") is None, reason="needs a C++ compiler")
@every_model
def test_compiled_code_agrees(name):
    compare_compiled(name, "inductor")


@pytest.mark.slow
@every_model
def test_export_agrees(name):
    model = build_model(name, max_disparity=32).eval()
    images = tuple(pair(32, 64))
    with torch.no_grad():
        program = torch.export.export(model, images, {"return_logits": True})
        other = tuple(pair(32, 64))
        assert_agrees(program.module()(*other, return_logits=True), model(*other, return_logits=True))


@every_model
def test_a_copy_is_independent(name):
    model = build_model(name, max_disparity=32).eval()
    twin = copy.deepcopy(model)
    images = pair(32, 64)
    with torch.no_grad():
        before = model(*images).disparity
        assert_close(twin(*images).disparity, before, rtol=0, atol=0)
        for p in twin.parameters():
            p.zero_()
        assert_close(model(*images).disparity, before, rtol=0, atol=0)
    assert twin.config == model.config


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (torch.rand(3, 32, 32), torch.rand(3, 32, 32), ["left", "(B, 3, H, W)", "(3, 32, 32)"]),
        (torch.rand(1, 1, 32, 32), torch.rand(1, 3, 32, 32), ["left", "(1, 1, 32, 32)"]),
        (torch.rand(1, 3, 32, 32), torch.rand(1, 4, 32, 32), ["right", "(1, 4, 32, 32)"]),
        (torch.rand(1, 3, 32, 33), torch.rand(1, 3, 32, 32), ["differ in size", "(1, 3, 32, 33)", "(1, 3, 32, 32)"]),
        (torch.rand(2, 3, 32, 32), torch.rand(1, 3, 32, 32), ["differ in size", "(2, 3, 32, 32)"]),
        (torch.rand(1, 3, 31, 64), torch.rand(1, 3, 31, 64), ["at least 32 x 32", "64 x 31"]),
        (torch.rand(1, 3, 64, 31), torch.rand(1, 3, 64, 31), ["at least 32 x 32", "31 x 64"]),
        (torch.ones(1, 3, 32, 32).int(), torch.ones(1, 3, 32, 32).int(), ["uint8, or float", "int32"]),
        (torch.ones(1, 3, 32, 32).bool(), torch.ones(1, 3, 32, 32).bool(), ["uint8, or float", "bool"]),
        (torch.ones(1, 3, 32, 32).byte(), torch.ones(1, 3, 32, 32), ["differ in type", "uint8", "float32"]),
        ("left.png", "right.png", ["left", "are str", "Predictor takes paths"]),
        (torch.rand(1, 3, 32, 32), np.ones((1, 3, 32, 32)), ["right", "are ndarray", "expected a tensor"]),
        (torch.rand(1, 3, 32, 32).to_sparse(), torch.rand(1, 3, 32, 32), ["left", "sparse", "to_dense()"]),
        (torch.rand(1, 3, 32, 32), torch.rand(1, 3, 32, 32, device="meta"), ["right", "on meta, the network on cpu"]),
    ],
)
def test_what_is_no_pair_of_images_is_refused(left, right, words):
    model = plain_network()
    with pytest.raises(InputError) as error:
        model(left, right)
    assert all(word in str(error.value) for word in words)


class Patches(nn.Module):
    """Each 4 x 4 patch as it is: a backbone without weights."""

    info = FeatureInfo(matching_channels={4: 48}, guide_channels={4: 48})
    multiple = 4

    def forward(self, images):
        self.seen = images
        patches = F.pixel_unshuffle(images, 4)
        return Features(matching={4: patches}, guides={4: patches})


class Similarity(nn.Module):
    """The cost as it is for logits, twice; keeps the guides that it is given."""

    in_channels = 1
    multiple = planes_multiple = 1
    upscale = 1
    loss_weights = (0.25, 1.0)

    def __init__(self, **guide_channels):
        super().__init__()
        self.guide_channels = {int(stride[1:]): channels for stride, channels in guide_channels.items()}

    def forward(self, volume, guides):
        self.guides = guides
        logits = 1000 * volume.squeeze(1)
        return (torch.zeros_like(logits), logits)


def plain_network(**changes):
    blocks = {
        "backbone": Patches(),
        "cost": CorrelationVolume(in_channels=48, planes=8),
        "aggregation": Similarity(),
        "regression": TopKSoftArgmin(1),
        "upsampler": BilinearUpsampler(scale=4),
    }
    names = ("mean", "std", "padding", "corner", "statistics")
    images = {"mean": [0.5, 0.5, 0.5], "std": [0.25, 0.25, 0.25]} | {n: changes.pop(n) for n in names if n in changes}
    return StereoModel(**{**blocks, "max_disparity": 32, **changes}, preprocessing=Preprocessing(**images))


@pytest.mark.parametrize("shift", [0, 4, 8, 20])
def test_modules_that_know_nothing_of_us_make_a_network_that_matches(shift):
    model = plain_network().eval()
    output = model(*shifted_pair(40, 80, shift))
    # patches left of the shift have no partner, and bilinear upsampling looks half a patch beyond
    assert_close(output.disparity[..., shift + 2 :], torch.full((1, 40, 78 - shift), float(shift)))
    assert output.confidence[..., shift + 2 :].min() > 0.99
    with pytest.raises(ConfigError, match="it has no configuration"):
        _ = model.config


@pytest.mark.parametrize(("upsampler", "levels"), [(BilinearUpsampler(scale=4), 8), (TrilinearUpsampler(scale=4), 32)])
def test_disparity_is_in_pixels_wherever_the_upsampling_is(upsampler, levels):
    model = plain_network(upsampler=upsampler, regression=TopKSoftArgmin(1)).eval()
    disparity = model(*shifted_pair(40, 80, 8)).disparity[..., 16:64]
    # trilinear upsampling spreads level 2 over the pixels 8 to 11
    assert (disparity >= 8).all()
    assert (disparity < (9 if levels == 8 else 12)).all()


def test_images_are_normalised_by_channel():
    model = plain_network(mean=[0.1, 0.2, 0.3], std=[0.5, 0.6, 0.7]).eval()
    left, right = pair(32, 36)
    model(left, right)
    expected = torch.cat((left, right))
    for c in range(3):
        expected[:, c] = (expected[:, c] - 0.1 * (c + 1)) / (0.5 + 0.1 * c)
    assert_close(model.backbone.seen, expected)


def test_integer_statistics_do_not_make_integer_images():
    model = plain_network(mean=[0, 0, 0], std=[1, 1, 1]).eval()
    left, right = pair(32, 36)
    model(left, right)
    assert_close(model.backbone.seen, torch.cat((left, right)))


@pytest.mark.parametrize(("padding", "border"), [("replicate", None), ("zeros", 0)])
def test_padding_follows_normalisation(padding, border):
    model = plain_network(padding=padding).eval()
    model(*pair(33, 38))
    seen = model.backbone.seen
    assert seen.shape == (2, 3, 36, 40)
    last_row = seen[..., 32:33, :] if border is None else torch.zeros(1)
    last_column = seen[..., 37:38] if border is None else torch.zeros(1)
    assert_close(seen[..., 33:, :], last_row.expand(2, 3, 3, 40))
    assert_close(seen[..., 38:], last_column.expand(2, 3, 36, 2))


@pytest.mark.parametrize(
    ("corner", "rows", "columns"),
    [("bottom_right", (0, 3), (0, 2)), ("top_right", (3, 0), (0, 2)), ("top_left", (3, 0), (2, 0))],
)
def test_padding_lies_in_the_corner_that_is_asked_for_and_is_cut_again(corner, rows, columns):
    left, right = pair(33, 38)
    padded = [F.pad(image, (*columns, *rows), mode="replicate") for image in (left, right)]
    model = plain_network(corner=corner).eval()
    disparity = model(left, right).disparity
    assert_close(model.backbone.seen, (torch.cat(padded) - 0.5) / 0.25)
    whole = plain_network().eval()(*padded).disparity
    assert_close(disparity, whole[:, rows[0] : rows[0] + 33, columns[0] : columns[0] + 38])
    # coarse predictions lie as the image does in training
    model.train()(left, right)
    assert_close(
        model.backbone.seen, (torch.cat([F.pad(i, (0, 2, 0, 3), mode="replicate") for i in (left, right)]) - 0.5) / 0.25
    )


def test_preprocessing_is_no_weight():
    model = plain_network()
    assert list(model.state_dict()) == []
    assert model.double().mean.dtype == torch.float64


def test_guides_are_of_the_left_image_and_averaged_where_too_fine():
    model = plain_network(aggregation=Similarity(s4=48, s16=48)).eval()
    assert model.multiple == 16
    left, right = pair(32, 48)
    model(left, right)
    normalised = F.pixel_unshuffle((left - 0.5) / 0.25, 4)
    assert_close(model.aggregation.guides[4], normalised)
    coarse = normalised.reshape(1, 48, 2, 4, 3, 4).mean((3, 5))
    assert_close(model.aggregation.guides[16], coarse)


def test_heads_are_auxiliary_but_for_the_last():
    model = plain_network(regression=SoftArgmin())
    left, right = shifted_pair(32, 64, 8)
    output = model(left, right)
    assert model.auxiliary_weights == (0.25,)
    (first,) = output.auxiliary
    assert_close(first, torch.full((1, 32, 64), 3.5 * 4))
    assert_close(output.disparity[..., 16:], torch.full((1, 32, 48), 8.0), rtol=0, atol=0.1)


class Doubling(nn.Module):
    """A learned upsampler, as far as the network can tell."""

    scale = 4
    domain = "disparity"
    learned = True
    guide_channels = {}  # noqa: RUF012

    def forward(self, x, guides):
        return 2 * bilinear_upsample(x, 4)


def test_a_learned_upsampler_adds_the_coarse_disparity_to_the_loss():
    model = plain_network(upsampler=Doubling())
    output = model(*shifted_pair(33, 64, 8))
    assert model.auxiliary_weights == (0.25, 0.3)
    first, coarse = output.auxiliary
    assert first.shape == coarse.shape == output.disparity.shape == (1, 33, 64)
    assert_close(2 * coarse, output.disparity)


def test_confidence_is_that_of_the_regression():
    model = plain_network(regression=TopKSoftArgmin(3)).eval()
    output = model(*pair(32, 48), return_logits=True)
    assert_close(output.confidence, bilinear_upsample(model.regression.with_confidence(output.logits)[1], 4))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"cost": CorrelationVolume(in_channels=47, planes=8)},
            ["backbone Patches", "cost CorrelationVolume", "48", "47"],
        ),
        ({"aggregation": Similarity(s4=40)}, ["backbone Patches", "aggregation Similarity", "48", "40"]),
        ({"regression": TopKSoftArgmin(9)}, ["regression TopKSoftArgmin", "9", "8"]),
        ({"upsampler": nn.Identity()}, ["upsampler Identity lacks scale, domain, learned, guide_channels"]),
        ({"max_disparity": 30}, ["30", "use 28 or 32"]),
        ({"padding": "mirror"}, ["padding='mirror'"]),
        ({"mean": [0.5, 0.5]}, ["mean is three numbers"]),
        ({"std": [0.5, 0.5, -1]}, ["std is three positive numbers"]),
        ({"mean": [0.5, 0.5, float("nan")]}, ["mean is three numbers"]),
    ],
)
def test_blocks_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(ConfigError) as error:
        plain_network(**changes)
    assert all(word in str(error.value) for word in words)
