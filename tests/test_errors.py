import pytest

from stereokit import CheckpointError, ConfigError, InputError, StereoKitError


@pytest.mark.parametrize("kind", [CheckpointError, ConfigError, InputError])
def test_errors_are_one_family_of_value_errors(kind):
    assert issubclass(kind, StereoKitError)
    assert issubclass(kind, ValueError)
    assert str(kind("what would work")) == "what would work"
