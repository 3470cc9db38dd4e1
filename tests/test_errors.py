import pytest

from stereokit import CheckpointError, ConfigError, InputError, StereoKitError
from stereokit.errors import printable


@pytest.mark.parametrize("kind", [CheckpointError, ConfigError, InputError])
def test_errors_are_one_family_of_value_errors(kind):
    assert issubclass(kind, StereoKitError)
    assert issubclass(kind, ValueError)
    assert str(kind("what would work")) == "what would work"


def test_a_message_is_one_printable_line():
    message = str(InputError("a\x1b[31m\nb\udcff c\u00e9"))
    assert message == "a\\x1b[31m\\nb\\udcff c\u00e9"


@pytest.mark.parametrize("name", ["a.png", "x" * 1000, "a\nb", "\udcff", b"\xff"])
def test_a_name_is_quoted_short_and_printable(name):
    text = printable(name)
    assert text.isprintable()
    assert len(text) <= 120
    assert printable("a'b.png") == repr("a'b.png")


@pytest.mark.parametrize("length", [10, 399, 400, 401, 30_000])
def test_of_a_long_message_the_middle_is_left_out(length):
    message = str(InputError("a" * length + "; use another"))
    assert len(message) < 400
    assert message.startswith("a" * 10)
    assert message.endswith("; use another")
    assert (" ... " in message) == (length > 386)
