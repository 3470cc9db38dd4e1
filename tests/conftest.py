"""Settings of every test."""

import pytest
import torch
from hypothesis import settings

settings.register_profile("stereokit", deadline=None)
settings.load_profile("stereokit")

# the tensors are tiny: threads that wait for each other cost more than they gain, most of all on a busy machine
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_weights_every_time():
    torch.manual_seed(0)
