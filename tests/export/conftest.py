import pytest
import torch

from tests.export.networks import Tiny


@pytest.fixture(scope="package")
def tiny() -> Tiny:
    torch.manual_seed(0)
    return Tiny().eval()
