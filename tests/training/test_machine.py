import math

import pytest

from stereokit.errors import ConfigError
from stereokit.training import Machine


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"workers": -1}, "workers is -1; expected at least 0"),
        ({"nodes": 0}, "nodes is 0; expected at least 1"),
        ({"devices": 0}, "devices is 0; expected at least 1"),
        ({"devices": 1.5}, "devices is 1.5; expected a whole number or text"),
        ({"checkpoint_every": True}, "checkpoint_every is True; expected a whole number"),
        ({"validate_every": math.inf}, "validate_every is inf; expected a whole number"),
        ({"precision": 16}, "precision is 16; expected text"),
        ({"compile": "yes"}, "compile is 'yes'; expected true or false"),
    ],
)
def test_a_bad_machine_is_explained(given, words):
    with pytest.raises(ConfigError, match=f"machine: {words}"):
        Machine(**given)
