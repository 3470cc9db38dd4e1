import pytest


@pytest.fixture
def no_hub(monkeypatch):
    """The hub must not be asked."""

    def asked(*given, **arguments):
        raise AssertionError(f"the hub was asked for {given}")

    monkeypatch.setattr("stereokit.weights.folder.hf_hub_download", asked)
