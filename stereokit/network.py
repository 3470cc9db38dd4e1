"""The door of every network: checks, normalisation, padding, cropping, saving."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import torch
from huggingface_hub import ModelHubMixin
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, NetworkConfig, Padding, Statistics
from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError, InputError
from stereokit.files import atomic_path
from stereokit.layers.casting import as_float
from stereokit.weights.folder import load_folder, save_folder

__all__ = ["MIN_SIZE", "Preprocessing", "StereoNetwork", "check_least_size", "least_size_of"]

MIN_SIZE = 32


@dataclass(frozen=True)
class Preprocessing:
    """What the door does to images before a network sees them.

    Args:
        mean, std: of the RGB channels, for normalisation.
        statistics: "fixed" for these numbers; "image" for each image's own mean and standard deviation per channel.
        padding: up to a multiple of the network's: the "replicate"d edge, "zeros" after normalisation as most published
            networks have, or "black" before it.
        corner: where the padding goes in eval mode, "bottom_right", "top_right" or "top_left". In training mode it is
            always "bottom_right", so that coarse predictions lie as the image does.

    Raises:
        ConfigError: another choice, or no three numbers.

    >>> Preprocessing().padding
    'replicate'
    """

    mean: Sequence[float] = IMAGENET_MEAN
    std: Sequence[float] = IMAGENET_STD
    statistics: Statistics = "fixed"
    padding: Padding = "replicate"
    corner: Corner = "bottom_right"

    def __post_init__(self) -> None:
        for name, choices in (("statistics", Statistics), ("padding", Padding), ("corner", Corner)):
            if getattr(self, name) not in get_args(choices):
                *others, last = map(repr, get_args(choices))
                raise ConfigError(f"{name}={getattr(self, name)!r} is unknown; use {', '.join(others)} or {last}")
        per_channel("mean", self.mean)
        per_channel("std", self.std, positive=True)


MODEL_CARD = """---
{{ card_data }}
---

A stereo matching network, saved by stereokit: `config.json` says what it is built
from, `model.safetensors` holds its weights. `stereokit.Predictor("this folder")` matches pairs of images with it.
"""


class StereoNetwork(
    nn.Module,
    ModelHubMixin,
    library_name="stereokit",
    tags=["stereo-matching"],
    model_card_template=MODEL_CARD,
):
    """Left and right images to disparity.

    This is the door; `match` is what a network writes. Images are RGB, uint8 or float in [0, 1], of any size from
    `least_size` up: they are normalised and padded here, and the disparity is cut back to their size.

    A class registered in `MODELS` takes plain JSON values as keyword arguments; then its networks can be saved, loaded,
    trained by a recipe, exported and described by name, as those made of slots (`StereoModel`) are.

    Args:
        max_disparity: D, in pixels; estimates lie in [0, D).
        multiple: height and width of what `match` gets are multiples of this.
        least_size: height and width that images have at least.
        loss_weights: of the predictions that `match` gives in training mode, in their order.
        preprocessing: normalisation and padding.
        config: what rebuilds the network; `build_model` sets it for a class that is registered.

    >>> class Middle(StereoNetwork):
    ...     def match(self, left, right):
    ...         return StereoOutput(torch.full_like(left[:, 0], self.max_disparity / 2))
    >>> Middle(max_disparity=64)(*torch.rand(2, 1, 3, 40, 50)).disparity.shape
    torch.Size([1, 40, 50])
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        *,
        max_disparity: int,
        multiple: int = 1,
        least_size: int = MIN_SIZE,
        loss_weights: Sequence[float] = (1.0,),
        preprocessing: Preprocessing | None = None,
        config: NetworkConfig | None = None,
    ) -> None:
        super().__init__()
        self.max_disparity = max_disparity
        self.multiple = multiple
        self.least_size = least_size
        self.loss_weights = tuple(loss_weights)
        self.preprocessing = preprocessing or Preprocessing()
        self._config = config
        self.register_buffer("mean", per_channel("mean", self.preprocessing.mean), persistent=False)
        self.register_buffer("std", per_channel("std", self.preprocessing.std), persistent=False)

    @property
    def config(self) -> NetworkConfig:
        """What `build_model` built the network from.

        Raises:
            ConfigError: the network was composed by hand.
        """
        if self._config is None:
            raise ConfigError("this network was not made by build_model: it has no configuration")
        return self._config

    @property
    def auxiliary_weights(self) -> tuple[float, ...]:
        """The weight in the loss of each prediction but the last, whose weight is 1."""
        *others, last = self.loss_weights
        return tuple(weight / last for weight in others)

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """What a network writes: images (B, 3, H, W), normalised and padded, to its output.

        The disparity has the size of the images. In training mode there is a prediction for each of `loss_weights`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method match(left, right)")

    def forward(self, left: Tensor, right: Tensor, *, return_logits: bool = False) -> StereoOutput:
        """Left and right images (B, 3, H, W) to disparity.

        Args:
            left: uint8 or float in [0, 1], RGB.
            right: likewise, of the same size and type.
            return_logits: in eval mode, give the prediction with its distribution too.

        Raises:
            InputError: the images are not a pair of RGB batches of at least the least size.
        """
        self._check_images(left, right)
        height, width = left.shape[-2:]
        output = self.match(self._prepare(left), self._prepare(right))
        # the padding above and on the left is what the image does not fill
        top, start = (
            whole - size if pads else 0
            for whole, size, pads in zip(output.disparity.shape[-2:], (height, width), self._pads_before, strict=True)
        )

        def cut(x: Tensor) -> Tensor:
            return x[:, top : top + height, start : start + width]

        return StereoOutput(
            disparity=cut(output.disparity),
            predictions=tuple(
                p._replace(disparity=cut(p.disparity)) if p.stride == 1 else p for p in output.predictions
            )
            if self.training or return_logits
            else (),
            confidence=None if output.confidence is None or self.training else cut(output.confidence),
        )

    def save_pretrained(
        self,
        save_directory: str | Path,
        *,
        push_to_hub: bool = False,
        repo_id: str | None = None,
        model_card_kwargs: dict[str, Any] | None = None,
        **hub_arguments: Any,
    ) -> str | None:
        """Writes the configuration and the weights into a folder, from where `from_pretrained` reads them.

        Args:
            save_directory: the folder; a network that is already there is replaced.
            push_to_hub: put the network on the hub too.
            repo_id: owner/name there; the folder's name by default.
            model_card_kwargs: for the card, README.md, which is written where there is none.
            hub_arguments: of `push_to_hub`: `private`, `token`, ...

        Returns:
            The address of the commit on the hub; None where there is none.

        Raises:
            ConfigError: a block of the network was passed in as a module, so that its configuration can't rebuild it.
        """
        # in place of the mixin's own, which begins by deleting the configuration that is there
        folder = Path(save_directory)
        save_folder(self, folder)
        card = folder / "README.md"
        if not card.exists():
            with atomic_path(card) as temporary:
                self.generate_model_card(**(model_card_kwargs or {})).save(temporary)
        if not push_to_hub:
            return None
        return self.push_to_hub(repo_id or folder.name, model_card_kwargs=model_card_kwargs, **hub_arguments)

    @classmethod
    def from_pretrained(cls, folder_or_id: str | Path, **hub_arguments: Any) -> "StereoNetwork":  # type: ignore[override]
        """Loads a network that `save_pretrained` wrote.

        Args:
            folder_or_id: a folder here, or a repository of the Hugging Face hub, owner/name.
            hub_arguments: `revision`, `cache_dir`, `token`, ... of `huggingface_hub`.

        Raises:
            CheckpointError: there is no such network, or its files are damaged.
        """
        return load_folder(str(folder_or_id), **hub_arguments)

    @property
    def _pads_before(self) -> tuple[bool, bool]:
        """Whether the padding lies above and on the left of the image."""
        corner = "bottom_right" if self.training else self.preprocessing.corner
        return corner.startswith("top"), corner.endswith("left")

    def _prepare(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W), normalised and padded up to the multiple."""
        images = as_float(images).to(self.mean.dtype)
        if self.preprocessing.padding == "black":
            return self._normalise(self._pad(images, "constant"))
        mode = "constant" if self.preprocessing.padding == "zeros" else "replicate"
        return self._pad(self._normalise(images), mode)

    def _normalise(self, images: Tensor) -> Tensor:
        if self.preprocessing.statistics == "fixed":
            return (images - self.mean) / self.std
        std, mean = torch.std_mean(images, dim=(2, 3), correction=0, keepdim=True)
        # an image of one colour has none
        return (images - mean) / std.clamp(min=1e-6)

    def _pad(self, images: Tensor, mode: str) -> Tensor:
        height, width = images.shape[-2:]
        # floor division, and no modulo of a negative number, which torch.export can't reason about
        below, right = ((size + self.multiple - 1) // self.multiple * self.multiple - size for size in (height, width))
        above, left = self._pads_before
        vertical = (below, 0) if above else (0, below)
        return F.pad(images, (*((right, 0) if left else (0, right)), *vertical), mode=mode)

    def _check_images(self, left: Tensor, right: Tensor) -> None:
        for name, image in (("left", left), ("right", right)):
            if not isinstance(image, Tensor):
                raise InputError(
                    f"the {name} images are {type(image).__name__}; expected a tensor (B, 3, H, W); Predictor takes "
                    "paths and arrays"
                )
            if image.layout is not torch.strided:
                raise InputError(f"the {name} images are sparse; expected a plain tensor, as its to_dense() gives")
            if image.device.type != self.mean.device.type:
                raise InputError(
                    f"the {name} images are on {image.device.type}, the network on {self.mean.device.type}; move one "
                    "with .to(device)"
                )
            if image.dim() != 4 or image.shape[1] != 3:
                raise InputError(f"the {name} images are RGB, (B, 3, H, W); got {tuple(image.shape)}")
            if image.dtype != torch.uint8 and not image.is_floating_point():
                raise InputError(f"the {name} images are uint8, or float in [0, 1]; got {image.dtype}")
        if left.shape != right.shape:
            raise InputError(f"left and right differ in size: {tuple(left.shape)} and {tuple(right.shape)}")
        if left.dtype != right.dtype:
            raise InputError(f"left and right differ in type: {left.dtype} and {right.dtype}")
        check_least_size(left.shape[-2], left.shape[-1], self.least_size)


def least_size_of(network: nn.Module) -> int:
    """Height and width that the images of any network have at least.

    >>> least_size_of(nn.Identity())
    32
    """
    return int(getattr(network, "least_size", MIN_SIZE))


def check_least_size(height: int, width: int, least: int = MIN_SIZE) -> None:
    """Raises `InputError` for images that are smaller than a network takes."""
    if min(height, width) < least:
        raise InputError(f"the images are {width} x {height} pixels; at least {least} x {least} are needed")


def per_channel(name: str, values: Sequence[float], *, positive: bool = False) -> Tensor:
    """One number per RGB channel, as (3, 1, 1)."""
    try:
        numbers = [] if isinstance(values, str) else [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = []
    # looked at as numbers, for the device at hand may hold tensors without data
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or (positive and min(numbers) <= 0):
        kind = "positive numbers" if positive else "numbers"
        raise ConfigError(f"{name} is three {kind}, one per RGB channel; got {values!r}")
    return torch.tensor(numbers, dtype=torch.float32).reshape(3, 1, 1)
