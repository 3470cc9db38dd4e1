"""Image encoders from timm, at strides 4 to 32."""

import difflib
from typing import Any

from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.registry import suggest

__all__ = ["MobileNetV2Encoder", "TimmEncoder", "build_encoder", "create_timm_model"]

STRIDES = (4, 8, 16, 32)


class TimmEncoder(nn.Module):
    """Any timm model that has features at strides 4, 8, 16 and 32.

    Args:
        name: a timm model, with or without its weights' tag.
        pretrained: load timm's weights for it.

    Raises:
        ConfigError: the model lacks one of the strides, or takes one size of image only.

    Shape: (B, 3, H, W), sides multiples of 32, to {4: (B, C4, H/4, W/4), ..., 32: (B, C32, H/32, W/32)}.

    >>> TimmEncoder("resnet18").channels
    {4: 64, 8: 128, 16: 256, 32: 512}
    """

    def __init__(self, name: str, *, pretrained: bool = False) -> None:
        super().__init__()
        model = create_timm_model(name, pretrained=pretrained, features_only=True)
        index = {reduction: i for i, reduction in enumerate(model.feature_info.reduction())}
        missing = [str(s) for s in STRIDES if s not in index]
        if missing:
            raise ConfigError(
                f"timm model {name!r} has no features at stride {', '.join(missing)} (it has "
                f"{', '.join(map(str, index))}); use a pyramid such as 'mobilenetv2_100' or 'resnet18'"
            )
        if any(getattr(module, "strict_img_size", False) for module in model.modules()):
            raise ConfigError(f"timm model {name!r} takes images of one fixed size; use a convolutional one")
        self.index = {s: index[s] for s in STRIDES}
        self.channels = {s: int(model.feature_info.channels()[i]) for s, i in self.index.items()}
        self.channels_last = str(getattr(model, "output_fmt", "NCHW")).endswith("NHWC")
        self.model = model

    def forward(self, images: Tensor) -> dict[int, Tensor]:
        """Images to features by stride."""
        maps = self.model(images)
        if self.channels_last:
            maps = [m.permute(0, 3, 1, 2) for m in maps]
        return {stride: maps[i] for stride, i in self.index.items()}


class MobileNetV2Encoder(nn.Module):
    """MobileNetV2 without its last stage: stride 32 has 160 channels, not the 320 that timm's own features give.

    Args:
        name: a MobileNetV2 of timm.
        pretrained: load timm's weights for it.

    Source: CoEx, section "Matching cost computation".

    >>> MobileNetV2Encoder("mobilenetv2_100").channels
    {4: 24, 8: 32, 16: 96, 32: 160}
    """

    def __init__(self, name: str = "mobilenetv2_100", *, pretrained: bool = False) -> None:
        super().__init__()
        model = create_timm_model(name, pretrained=pretrained)
        self.conv_stem = model.conv_stem
        self.bn1 = model.bn1
        stride2, stride4, stride8, stride16a, stride16b, stride32 = list(model.blocks)[:6]
        self.stages = nn.ModuleList(
            [nn.Sequential(stride2, stride4), stride8, nn.Sequential(stride16a, stride16b), stride32]
        )
        self.channels = {
            stride: int(next(m for m in reversed(list(stage.modules())) if isinstance(m, nn.BatchNorm2d)).num_features)
            for stride, stage in zip(STRIDES, self.stages, strict=True)
        }

    def forward(self, images: Tensor) -> dict[int, Tensor]:
        """Images to features by stride."""
        x = self.bn1(self.conv_stem(images))
        features = {}
        for stride, stage in zip(STRIDES, self.stages, strict=True):
            x = stage(x)
            features[stride] = x
        return features


def build_encoder(name: str, *, pretrained: bool = False) -> TimmEncoder | MobileNetV2Encoder:
    """The encoder over a timm model; MobileNetV2 is cut as in CoEx.

    Raises:
        ConfigError: timm does not know the name, or the model lacks a stride.
    """
    kind = MobileNetV2Encoder if name.startswith("mobilenetv2") else TimmEncoder
    return kind(name, pretrained=pretrained)


def is_timm_model(name: str) -> bool:
    """Whether timm can build a model of this name."""
    import timm

    return bool(timm.is_model(name))


def near_timm_models(name: str) -> list[str]:
    """The names of timm models that look like this one."""
    import timm

    return difflib.get_close_matches(name, timm.list_models(), n=3, cutoff=0.7)


def create_timm_model(name: str, **arguments: Any) -> Any:
    """A model of timm.

    Raises:
        ConfigError: timm does not know the name, or can't build it so.
    """
    # timm brings torchvision and takes a second to import: only networks that use it pay for it
    import timm

    if not timm.is_model(name):
        near = suggest(name, timm.list_models()).split("Known:")[0]
        raise ConfigError(f"unknown timm model {name!r}; {near}see timm.list_models()")
    try:
        return timm.create_model(name, **arguments)
    except (OSError, RuntimeError, AssertionError) as error:
        reason = str(error).strip().split("\n")[0]
        if arguments.get("pretrained"):
            raise ConfigError(f"timm could not load pretrained weights for {name!r}: {reason}") from error
        raise ConfigError(f"timm model {name!r} gives no feature pyramid: {reason}") from error
