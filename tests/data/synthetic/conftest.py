import pytest

from stereokit.data.synthetic import SyntheticScenes


@pytest.fixture(scope="session")
def scenes():
    """Scenes as the cameras' differences leave them alone."""
    return SyntheticScenes(seed=3, size=(96, 192), max_disparity=48, photometric=0)


@pytest.fixture(scope="session")
def bank(scenes):
    return scenes.bank
