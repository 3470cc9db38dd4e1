import pytest
import timm
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import ConfigError
from stereokit.backbones import MobileNetV2Encoder, TimmEncoder
from stereokit.backbones.encoder import build_encoder, is_timm_model

ENCODERS = {
    "mobilenetv2_100": (24, 32, 96, 160),
    "mobilenetv3_large_100": (24, 40, 112, 960),
    "efficientnet_b0": (24, 40, 112, 320),
    "resnet18": (64, 128, 256, 512),
    "convnext_atto": (40, 80, 160, 320),
}


@pytest.mark.parametrize(("name", "channels"), ENCODERS.items())
def test_features_have_the_channels_and_strides_they_promise(name, channels):
    encoder = build_encoder(name).eval()
    assert encoder.channels == dict(zip((4, 8, 16, 32), channels, strict=True))
    features = encoder(torch.rand(1, 3, 64, 96))
    assert {s: tuple(f.shape) for s, f in features.items()} == {
        s: (1, c, 64 // s, 96 // s) for s, c in encoder.channels.items()
    }


def test_mobilenet_v2_alone_is_cut():
    assert isinstance(build_encoder("mobilenetv2_100"), MobileNetV2Encoder)
    assert isinstance(build_encoder("mobilenetv3_small_050"), TimmEncoder)


def test_mobilenet_v2_is_that_of_timm():
    whole = timm.create_model("mobilenetv2_100").eval()
    encoder = MobileNetV2Encoder().eval()
    state = whole.state_dict()
    own = {"stages.0.0": 0, "stages.0.1": 1, "stages.1": 2, "stages.2.0": 3, "stages.2.1": 4, "stages.3": 5}
    renamed = {k: state[k] for k in state if k.startswith(("conv_stem.", "bn1."))}
    for ours, block in own.items():
        prefix = f"blocks.{block}."
        renamed.update({f"{ours}.{k.removeprefix(prefix)}": v for k, v in state.items() if k.startswith(prefix)})
    encoder.load_state_dict(renamed)
    images = torch.randn(1, 3, 64, 96)
    features = encoder(images)
    x = whole.bn1(whole.conv_stem(images))
    for block, stride in enumerate([None, 4, 8, None, 16, 32]):
        x = whole.blocks[block](x)
        if stride:
            assert_close(features[stride], x)


def test_features_of_channels_last_models_are_turned(monkeypatch):
    class ChannelsLast(nn.Module):
        output_fmt = "NHWC"

        class feature_info:
            reduction = staticmethod(lambda: [4, 8, 16, 32])
            channels = staticmethod(lambda: [1, 2, 3, 4])

        def forward(self, x):
            return [
                x.new_zeros(x.shape[0], x.shape[2] // s, x.shape[3] // s, c)
                for s, c in ((4, 1), (8, 2), (16, 3), (32, 4))
            ]

    monkeypatch.setattr(timm, "create_model", lambda name, **_: ChannelsLast())
    features = TimmEncoder("resnet18")(torch.rand(2, 3, 64, 96))
    assert {s: tuple(f.shape) for s, f in features.items()} == {
        4: (2, 1, 16, 24),
        8: (2, 2, 8, 12),
        16: (2, 3, 4, 6),
        32: (2, 4, 2, 3),
    }


@pytest.mark.parametrize("name", ["mobilenetv2_100", "resnet18"])
@pytest.mark.parametrize("pretrained", [False, True])
def test_pretrained_passes_to_timm(monkeypatch, name, pretrained):
    asked = []
    create = timm.create_model

    def spy(name, *, pretrained=False, **arguments):
        asked.append(pretrained)
        return create(name, **arguments)

    monkeypatch.setattr(timm, "create_model", spy)
    build_encoder(name, pretrained=pretrained)
    assert asked == [pretrained]


def test_weights_that_do_not_load_are_reported(monkeypatch):
    def offline(name, **arguments):
        raise RuntimeError("no network here")

    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(ConfigError, match="pretrained weights for 'resnet18': no network here"):
        TimmEncoder("resnet18", pretrained=True)
    with pytest.raises(ConfigError, match="'resnet18' gives no feature pyramid: no network here"):
        TimmEncoder("resnet18")


def test_unknown_models_are_answered_with_near_ones():
    with pytest.raises(ConfigError, match=r"unknown timm model 'resnet81'; did you mean .*'resnet18'"):
        build_encoder("resnet81")


def test_models_without_a_pyramid_are_refused():
    with pytest.raises(ConfigError, match=r"'vit_tiny_patch16_224' has no features at stride 4, 8, 32 \(it has 16\)"):
        build_encoder("vit_tiny_patch16_224")


def test_timm_names_are_known():
    assert is_timm_model("resnet18")
    assert is_timm_model("resnet18.a1_in1k")
    assert not is_timm_model("unet")
