from pathlib import Path

import numpy as np
import pytest
import torch

from stereokit import build_model
from stereokit.data import write_image


@pytest.fixture(scope="package")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    build_model("coex", max_disparity=64).save_pretrained(folder)
    return str(folder)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for name in ("a", "b"):
            write_image(tmp_path / side / f"{name}.png", rng.integers(0, 256, (40, 50, 3), dtype=np.uint8))
    return tmp_path
