"""Weights: saved networks, and published checkpoints turned into ours."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from huggingface_hub import hf_hub_download
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from stereokit._version import __version__
from stereokit.errors import CheckpointError, ConfigError

if TYPE_CHECKING:
    from stereokit.model import StereoModel

WEIGHTS_NAME = "model.safetensors"
CONFIG_NAME = "config.json"
