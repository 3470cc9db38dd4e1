"""The network: one choice per slot."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from huggingface_hub import ModelHubMixin
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import (
    Aggregation,
    Backbone,
    Cost,
    Regression,
    Upsampler,
    check_contracts,
    input_multiple,
    regression_levels,
)
from stereokit.data.inputs import as_float
from stereokit.errors import ConfigError, InputError
from stereokit.files import atomic_path
from stereokit.upsampling.interpolation import bilinear_upsample
from stereokit.weights.folder import load_folder, save_folder

if TYPE_CHECKING:
    from stereokit.config import ModelConfig

__all__ = ["StereoModel", "StereoOutput"]

MIN_SIZE = 32


def check_least_size(height: int, width: int) -> None:
    """Raises `InputError` for images below 32 x 32."""
    if min(height, width) < MIN_SIZE:
        raise InputError(f"the images are {width} x {height} pixels; at least {MIN_SIZE} x {MIN_SIZE} are needed")


class StereoOutput(NamedTuple):
    """What every network returns, in training and in eval mode alike."""

    disparity: Tensor
    """(B, H, W), pixels of the left image."""
    auxiliary: tuple[Tensor, ...] = ()
    """(B, H, W) each, for the loss, as `StereoModel.auxiliary_weights` orders them. Empty in eval mode."""
    confidence: Tensor | None = None
    """(B, H, W) in [0, 1]: the probability mass behind the estimate. None in training mode."""
    logits: Tensor | None = None
    """(B, D', H', W') of the best head, larger is better, of the padded input. None unless asked for."""


MODEL_CARD = """---
{{ card_data }}
---

A stereo matching network, saved by stereokit: `config.json` says what it is built
from, `model.safetensors` holds its weights. `stereokit.Predictor("this folder")` matches pairs of images with it.
"""


class StereoModel(
    nn.Module,
    ModelHubMixin,
    library_name="stereokit",
    tags=["stereo-matching"],
    model_card_template=MODEL_CARD,
):
    """Left and right images to disparity, through a backbone, a cost, an aggregation, a regression and an upsampler.

    `build_model` makes one by name. Images are RGB, uint8 or float in [0, 1], of any size from 32 x 32 up: they are
    normalised and padded at the right and at the bottom inside, and the disparity is cut back to their size.

    Args:
        backbone, cost, aggregation, regression, upsampler: see `stereokit.contracts`.
        max_disparity: D, in pixels; estimates lie in [0, D).
        mean, std: of the RGB channels, for normalisation.
        padding: of the images up to a multiple of `self.multiple`: their "replicate"d edge, or "zeros" after
            normalisation as published.
        config: what rebuilds the network, see `ModelConfig`.

    Raises:
        ConfigError: neighbouring blocks do not fit.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=64).eval()
    >>> left = right = torch.rand(1, 3, 50, 70)
    >>> model(left, right).disparity.shape
    torch.Size([1, 50, 70])
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        *,
        backbone: Backbone,
        cost: Cost,
        aggregation: Aggregation,
        regression: Regression,
        upsampler: Upsampler,
        max_disparity: int,
        mean: Sequence[float],
        std: Sequence[float],
        padding: Literal["replicate", "zeros"] = "replicate",
        config: "ModelConfig | None" = None,
    ) -> None:
        super().__init__()
        check_contracts(
            backbone=backbone,
            cost=cost,
            aggregation=aggregation,
            regression=regression,
            upsampler=upsampler,
            max_disparity=max_disparity,
        )
        if padding not in ("replicate", "zeros"):
            raise ConfigError(f"padding={padding!r} is unknown; use 'replicate' or 'zeros'")
        self.backbone = backbone
        self.cost = cost
        self.aggregation = aggregation
        self.regression = regression
        self.upsampler = upsampler
        self.max_disparity = max_disparity
        self.padding = padding
        self._config = config
        self.multiple = input_multiple(backbone, aggregation, upsampler)
        self.pixels_per_level = max_disparity // regression_levels(max_disparity, upsampler.scale, upsampler)
        self.register_buffer("mean", per_channel("mean", mean), persistent=False)
        self.register_buffer("std", per_channel("std", std, positive=True), persistent=False)

    @property
    def config(self) -> "ModelConfig":
        """What `build_model` built the network from.

        Raises:
            ConfigError: the network was composed by hand.
        """
        if self._config is None:
            raise ConfigError("this network was not made by build_model: it has no configuration")
        return self._config

    @property
    def auxiliary_weights(self) -> tuple[float, ...]:
        """The weight in the loss of each auxiliary disparity; that of the final one is 1."""
        coarse = (0.3,) if self.upsampler.learned else ()
        return (*self.aggregation.auxiliary_weights, *coarse)

    @property
    def first_level(self) -> float:
        """The disparity of the first level of the logits, in pixels; each further one is `upsampler.scale` more.

        Not 0 where the logits are upsampled: the coarse level is then the middle of as many fine ones.
        """
        return (self.upsampler.scale - 1) / 2 if self.upsampler.domain == "volume" else 0.0

    def forward(self, left: Tensor, right: Tensor, *, return_logits: bool = False) -> StereoOutput:
        """Left and right images (B, 3, H, W) to disparity.

        Raises:
            InputError: the images are not a pair of RGB batches of at least 32 x 32.
        """
        self._check_images(left, right)
        height, width = left.shape[-2:]
        images = self._pad(self._normalise(torch.cat((left, right))))

        features = self.backbone(images)
        left_features, right_features = features.matching.chunk(2)
        guides = self._left_guides(features.guides)
        volume = self.cost(left_features, right_features)
        heads = self.aggregation(volume, guides)
        if not self.training:
            return self._best(heads[-1], guides, (height, width), return_logits)

        coarse = [self._regress(logits, guides) for logits in heads]
        full = [self._upsample("disparity", disparity, guides) for disparity in coarse]
        auxiliary = full[:-1]
        if self.upsampler.learned:
            auxiliary.append(self._enlarge(coarse[-1]))
        return StereoOutput(
            disparity=full[-1][:, :height, :width],
            auxiliary=tuple(disparity[:, :height, :width] for disparity in auxiliary),
            logits=heads[-1] if return_logits else None,
        )

    def _regress(self, logits: Tensor, guides: dict[int, Tensor]) -> Tensor:
        return self.regression(self._upsample("volume", logits, guides)) * self.pixels_per_level

    def _best(
        self, logits: Tensor, guides: dict[int, Tensor], size: tuple[int, int], return_logits: bool
    ) -> StereoOutput:
        """What eval mode gives: the disparity of the best head and its confidence."""
        height, width = size
        distribution = self._upsample("volume", logits, guides)
        with_confidence = getattr(self.regression, "with_confidence", None)
        if with_confidence is None:
            coarse, confidence = self.regression(distribution), self.regression.confidence(distribution)
        else:
            coarse, confidence = with_confidence(distribution)
        disparity = self._upsample("disparity", coarse * self.pixels_per_level, guides)
        return StereoOutput(
            disparity=disparity[:, :height, :width],
            confidence=self._enlarge(confidence)[:, :height, :width],
            logits=logits if return_logits else None,
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
            hub_arguments: of `push_to_hub`: `private`, `token`, ..

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
    def from_pretrained(cls, folder_or_id: str | Path, **hub_arguments: Any) -> "StereoModel":  # type: ignore[override]
        """Loads a network that `save_pretrained` wrote.

        Args:
            folder_or_id: a folder here, or a repository of the Hugging Face hub, owner/name.
            hub_arguments: `revision`, `cache_dir`, `token`, .. of `huggingface_hub`.

        Raises:
            CheckpointError: there is no such network, or its files are damaged.
        """
        return load_folder(str(folder_or_id), **hub_arguments)

    def _normalise(self, images: Tensor) -> Tensor:
        return (as_float(images).to(self.mean.dtype) - self.mean) / self.std

    def _pad(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        # floor division, and no modulo of a negative number, which torch.export can't reason about
        bottom, right = ((size + self.multiple - 1) // self.multiple * self.multiple - size for size in (height, width))
        right_and_bottom = (0, right, 0, bottom)
        return F.pad(images, right_and_bottom, mode="constant" if self.padding == "zeros" else "replicate")

    def _left_guides(self, guides: dict[int, Tensor]) -> dict[int, Tensor]:
        """The guides of the left half of the batch; those coarser than the backbone gives are averaged."""
        left = {stride: guide.chunk(2)[0] for stride, guide in guides.items()}
        coarsest = self.backbone.info.coarsest_guide
        for stride in (*self.aggregation.guide_channels, *self.upsampler.guide_channels):
            if stride not in left:
                left[stride] = F.avg_pool2d(left[coarsest], stride // coarsest)
        return left

    def _upsample(self, domain: Literal["volume", "disparity"], x: Tensor, guides: dict[int, Tensor]) -> Tensor:
        """The upsampler acts before the regression, on logits, or after it, on disparities."""
        return self.upsampler(x, guides) if self.upsampler.domain == domain else x

    def _enlarge(self, x: Tensor) -> Tensor:
        """From the stride of the regression to full resolution, by interpolation."""
        return bilinear_upsample(x, self.upsampler.scale) if self.upsampler.domain == "disparity" else x

    def _check_images(self, left: Tensor, right: Tensor) -> None:
        for name, image in (("left", left), ("right", right)):
            if image.dim() != 4 or image.shape[1] != 3:
                raise InputError(f"the {name} images are RGB, (B, 3, H, W); got {tuple(image.shape)}")
            if image.dtype != torch.uint8 and not image.is_floating_point():
                raise InputError(f"the {name} images are uint8, or float in [0, 1]; got {image.dtype}")
        if left.shape != right.shape:
            raise InputError(f"left and right differ in size: {tuple(left.shape)} and {tuple(right.shape)}")
        if left.dtype != right.dtype:
            raise InputError(f"left and right differ in type: {left.dtype} and {right.dtype}")
        check_least_size(*left.shape[-2:])


def per_channel(name: str, values: Sequence[float], *, positive: bool = False) -> Tensor:
    """One number per RGB channel, as (3, 1, 1)."""
    try:
        tensor = torch.tensor(values, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        tensor = torch.empty(0)
    if tensor.shape != (3,) or not tensor.isfinite().all() or (positive and not (tensor > 0).all()):
        kind = "positive numbers" if positive else "numbers"
        raise ConfigError(f"{name} is three {kind}, one per RGB channel; got {values!r}")
    return tensor.reshape(3, 1, 1)
