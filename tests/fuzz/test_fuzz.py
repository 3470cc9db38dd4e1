import os

import pytest

from tests.fuzz.kinds import COMMANDS, FILES, KINDS, LIBRARY
from tests.fuzz.running import fuzz

LONG = int(os.environ.get("STEREOKIT_FUZZ", 100_000))


def quick(kinds):
    return {kind: KINDS[kind].quick for kind in kinds}


def failures(outcomes):
    return {kind: outcome.failures for kind, outcome in outcomes.items() if outcome.failures}


def test_damaged_files_of_data():
    outcomes = fuzz(quick(FILES), perturb=85)
    assert failures(outcomes) == {}
    for outcome in outcomes.values():
        assert outcome.read + outcome.refused == outcome.inputs
        # damage that is always noticed at once reaches nothing, damage that never is does nothing
        assert outcome.read > 0
        assert outcome.refused > 0
    again = fuzz(quick(FILES), perturb=170)
    # else a result holds what memory held
    assert [kind for kind in FILES if again[kind].digest != outcomes[kind].digest] == []


def test_damaged_files_of_the_library():
    outcomes = fuzz(quick(LIBRARY))
    assert failures(outcomes) == {}
    for outcome in outcomes.values():
        assert outcome.read + outcome.refused == outcome.inputs
        # what is never read does not reach the networks
        assert outcome.read > 0
        assert outcome.refused > 0


def test_the_same_number_is_the_same_damage():
    kind = KINDS["config"]
    seeds = kind.seeds()
    before = [kind.input(seeds, number) for number in range(300)]
    assert [kind.input(seeds, number) for number in reversed(range(300))] == before[::-1]


@pytest.mark.slow
def test_commands_on_damaged_files():
    outcomes = fuzz(quick(COMMANDS))
    assert failures(outcomes) == {}
    assert all(outcome.refused > 0 for outcome in outcomes.values())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files(kind):
    assert failures(fuzz({kind: max(1, LONG // KINDS[kind].long)}, first=10_000)) == {}
