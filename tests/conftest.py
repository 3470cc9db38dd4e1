"""Settings of every test."""

import os

import pytest
import torch
from hypothesis import settings

# the same examples every time, so that nothing that lands fails by chance; "random" draws others and remembers failures
settings.register_profile("fixed", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("random", deadline=None)
settings.load_profile(os.environ.get("STEREOKIT_EXAMPLES", "fixed"))

# the tensors are tiny: threads that wait for each other cost more than they gain, most of all on a busy machine
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_weights_every_time():
    torch.manual_seed(0)
