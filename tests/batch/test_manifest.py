import json
import subprocess
import sys
from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.batch.manifest import MANIFEST_NAME, Manifest, PairRecord, Records
from stereokit.errors import InputError


def record(name, outcome="matched", **more):
    return PairRecord(pair=name, outcome=outcome, left="l", right="r", weights="w", settings={"scale": 1.0}, **more)


def write(folder, *records):
    with Manifest(folder, end=Records(folder).end) as manifest:
        for one in records:
            manifest.finish(one, [])


@given(
    st.text(),
    st.dictionaries(st.text(), st.text()),
    st.none() | st.floats(allow_nan=False, allow_infinity=False),
    st.none() | st.lists(st.integers(), min_size=2, max_size=2),
)
def test_a_record_is_one_line_that_tells_all(name, files, number, size):
    given = record(name, files=files, seconds=number, size=size)
    line = given.to_json()
    assert "\n" not in line
    assert asdict(PairRecord.from_json(line)) == asdict(given)


def test_the_last_record_of_a_pair_counts(tmp_path):
    write(tmp_path, record("a", "failed", error="broken"), record("b"))
    write(tmp_path, record("a", seconds=2.0))
    records = Records(tmp_path)
    assert len(records) == 2
    assert {one.pair: one.outcome for one in records} == {"a": "matched", "b": "matched"}
    assert records.get("a").seconds == 2.0
    assert records.get("c") is None
    assert len((tmp_path / MANIFEST_NAME).read_text().splitlines()) == 3


def test_a_line_that_was_cut_short_does_not_count_and_does_no_harm(tmp_path):
    write(tmp_path, record("a"), record("b"))
    whole = (tmp_path / MANIFEST_NAME).read_bytes()
    for cut in (1, 20, len(record("b").to_json())):
        (tmp_path / MANIFEST_NAME).write_bytes(whole[:-cut])
        assert [one.pair for one in Records(tmp_path)] == ["a"]
        write(tmp_path, record("c"))
        assert [one.pair for one in Records(tmp_path)] == ["a", "c"]
    # another version may say more
    line = json.dumps({**json.loads(record("d").to_json()), "novel": 1})
    with open(tmp_path / MANIFEST_NAME, "a") as file:
        file.write(f"{line}\n")
    assert Records(tmp_path).get("d").pair == "d"


@pytest.mark.parametrize("line", ["{", "[]", "3", '{"pair": "a"}', "", "\x00"])
def test_a_line_that_is_no_record_is_an_error(tmp_path, line):
    write(tmp_path, record("a"))
    with open(tmp_path / MANIFEST_NAME, "a") as file:
        file.write(f"{line}\n")
    with pytest.raises(InputError, match=r"manifest.jsonl', line 2 is no record of a pair") as refusal:
        Records(tmp_path)
    assert "\n" not in str(refusal.value)


def test_the_files_appear_with_the_record(tmp_path):
    (tmp_path / "old.png").write_text("of a result before")
    with Manifest(tmp_path) as manifest:
        (manifest.staging / "a.pfm").write_text("new")
        assert not (tmp_path / "a.pfm").exists()
        manifest.finish(record("a", files={"a.pfm": "hash"}), ["a.pfm", "old.png"])
        (manifest.staging / "b.pfm").write_text("half")
        manifest.finish(record("b", "failed", error="no space"), ["b.pfm"])
        assert not list(manifest.staging.iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pfm", MANIFEST_NAME]


def test_what_a_kill_left_is_removed(tmp_path):
    with Manifest(tmp_path) as manifest:
        staging = manifest.staging
    staging.mkdir()
    (staging / "half.pfm").write_text("half")
    with Manifest(tmp_path):
        assert not list(staging.iterdir())
    assert not staging.exists()


def test_a_full_disk_leaves_whole_lines(tmp_path):
    write(tmp_path, record("a"))
    with Manifest(tmp_path, end=Records(tmp_path).end) as manifest:
        file = manifest._file

        class Full:
            name, seek, truncate, close = file.name, file.seek, file.truncate, file.close

            def write(self, line):
                return file.write(line[:30])

        manifest._file = Full()
        with pytest.raises(InputError, match="can't be written: No space left on device"):
            manifest.finish(record("b"), [])
        manifest._file = file
        manifest.finish(record("c"), [])
    assert [one.pair for one in Records(tmp_path)] == ["a", "c"]


@pytest.mark.skipif(sys.platform == "win32", reason="no such lock there")
def test_one_process_at_a_time_adds_to_it(tmp_path):
    program = f"""
import fcntl, sys
file = open({str(tmp_path / MANIFEST_NAME)!r}, "ab")
fcntl.flock(file, fcntl.LOCK_EX)
print("locked", flush=True)
sys.stdin.read()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(InputError, match="another process writes results into"):
            Manifest(tmp_path)
        other.stdin.close()
    write(tmp_path, record("a"))
