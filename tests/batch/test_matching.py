import json
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from stereokit import ConfigError, InputError, Predictor
from stereokit.batch import MANIFEST_NAME, Records, match_files
from stereokit.data import read_disparity
from stereokit.runtime.provenance import file_sha256
from tests.batch.opening import Brightness, interrupt, open_brightness, open_killed, write_pairs

COUNT = 5
ROOT = Path(__file__).parents[2]


@pytest.fixture
def pairs(tmp_path):
    return write_pairs(tmp_path / "in", COUNT, np.random.default_rng(0))


def results(folder):
    """The content of every file but the manifest."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.name != MANIFEST_NAME}


def told(pairs, out, **how):
    """What was told of each pair: "done", "matched", "again: ..." or the error."""
    said = []

    def tell(pair, outcome):
        if isinstance(outcome, InputError):
            said.append((pair.name, str(outcome)))
        else:
            word = "done" if outcome.done_before else f"again: {outcome.again}" if outcome.again else "matched"
            said.append((pair.name, word))

    summary = match_files(pairs, how.pop("predictor", open_brightness), out, tell=tell, **how)
    assert summary.matched + summary.done_before + len(summary.failed) == len(said) == len(pairs)
    assert [name for name, _ in said] == [pair.name for pair in pairs]
    return dict(said)


def test_the_files_are_those_of_single_pairs_and_the_manifest_tells_of_each(pairs, tmp_path):
    predictor = open_brightness(None)
    summary = match_files(pairs, predictor, tmp_path / "out")
    for pair in pairs:
        predictor(pair.left, pair.right).save_all(tmp_path / "single", pair.name)
    assert results(tmp_path / "out") == results(tmp_path / "single")
    assert (summary.matched, summary.done_before, summary.failed) == (COUNT, 0, [])
    assert 0 < summary.busy <= 1
    lines = [json.loads(line) for line in (tmp_path / "out" / MANIFEST_NAME).read_text().splitlines()]
    assert [line["pair"] for line in lines] == [pair.name for pair in pairs]
    for pair, line in zip(pairs, lines, strict=True):
        disparity = read_disparity(tmp_path / "out" / f"{pair.name}_disparity.pfm")
        assert line["outcome"] == "matched"
        assert (line["left"], line["left_sha256"]) == (str(pair.left), file_sha256(pair.left))
        assert (line["right"], line["right_sha256"]) == (str(pair.right), file_sha256(pair.right))
        assert line["disparity"] == [disparity.min(), disparity.max()]
        assert line["size"] == list(disparity.shape)
        assert line["mean_confidence"] == 0.75
        assert line["seconds"] > 0
        assert len(line["weights"]) == 64
        assert line["settings"]["backend"] == "torch"
        assert line["files"] == {path.name: file_sha256(path) for path in (tmp_path / "out").glob(f"{pair.name}_*")}


def test_any_number_of_workers_gives_the_same_to_the_bit(pairs, tmp_path):
    for workers in (0, 1, 3):
        assert set(told(pairs, tmp_path / str(workers), workers=workers).values()) == {"matched"}
    assert results(tmp_path / "0") == results(tmp_path / "1") == results(tmp_path / "3")
    records = [[one.files for one in Records(tmp_path / str(workers))] for workers in (0, 1, 3)]
    assert records[0] == records[1] == records[2]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_failing_pair_is_told_and_recorded_and_the_others_are_matched(pairs, tmp_path, workers):
    pairs[2].left.write_bytes(b"broken")
    said = told(pairs, tmp_path / "out", workers=workers)
    error = said.pop("2")
    assert "2.png' is no image" in error
    assert set(said.values()) == {"matched"}
    failed = Records(tmp_path / "out").get("2")
    assert (failed.outcome, failed.files) == ("failed", {})
    assert failed.error == error
    assert failed.left_sha256 == file_sha256(pairs[2].left)
    assert not list((tmp_path / "out").glob("2_*"))
    # a second time it is tried again, and once it can be read it is matched
    assert told(pairs, tmp_path / "out", workers=workers)["2"] == said.get(
        "2", Records(tmp_path / "out").get("2").error
    )
    pairs[2].left.write_bytes(pairs[1].left.read_bytes())
    assert told(pairs, tmp_path / "out", workers=workers)["2"] == "matched"


def test_a_second_run_does_what_is_not_done_and_whole(pairs, tmp_path):
    out = tmp_path / "out"
    assert set(told(pairs[:3], out).values()) == {"matched"}
    before = results(out)
    (out / "0_disparity.pfm").unlink()
    damaged = bytearray(before["1_disparity.npz"])
    damaged[100] ^= 1
    (out / "1_disparity.npz").write_bytes(damaged)
    said = told(pairs, out)
    assert said == {
        "0": "again: 0_disparity.pfm is missing or damaged",
        "1": "again: 1_disparity.npz is missing or damaged",
        "2": "done",
        "3": "matched",
        "4": "matched",
    }
    assert {name: data for name, data in results(out).items() if name in before} == before
    assert set(told(pairs, out).values()) == {"done"}


def test_whole_results_of_other_weights_settings_or_images_are_replaced_when_told(pairs, tmp_path):
    out = tmp_path / "out"
    told(pairs, out)
    before = results(out)
    with pytest.raises(InputError, match=r"5 results in .* were made with other weights; .*--overwrite") as refusal:
        told(pairs, out, predictor=Predictor(Brightness(30.0), device="cpu"))
    assert "\n" not in str(refusal.value)
    larger = Predictor(Brightness(), device="cpu", scale=1.5)
    with pytest.raises(InputError, match=r"were made with other settings \(limits None, not \{'scale': 1.5"):
        told(pairs, out, predictor=larger)
    assert results(out) == before
    # a copy of another pair's image in its place
    pairs[0].left.write_bytes(pairs[1].left.read_bytes())
    said = told(pairs, out)
    assert "is of other images" in said["0"]
    assert results(out) == before
    assert Records(out).get("0").outcome == "matched"
    assert told(pairs, out, overwrite=True) == {"0": "again: other images"} | dict.fromkeys("1234", "done")
    assert set(told(pairs, out, predictor=larger, overwrite=True).values()) == {
        "again: other settings (limits None, not {'scale': 1.5, 'max_memory': None, 'too_large': 'error'})"
    }
    assert set(told(pairs, out, predictor=larger).values()) == {"done"}
    # where nothing would be lost nobody is asked
    for name in results(out):
        (out / name).unlink()
    assert all(word.startswith("again: other settings") for word in told(pairs, out).values())


def test_files_that_no_manifest_names_are_kept(pairs, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "3_picture.png").write_text("precious")
    with pytest.raises(InputError, match=r"3_picture.png' exists already"):
        told(pairs, out)
    assert [path.name for path in out.iterdir()] == ["3_picture.png"]
    assert set(told(pairs, out, overwrite=True).values()) == {"matched"}


@pytest.mark.parametrize("workers", [0, 2])
def test_an_interrupted_run_keeps_what_was_matched_and_goes_on(pairs, tmp_path, workers):
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        told(pairs, out, predictor=Predictor(Brightness(ends=interrupt), device="cpu"), workers=workers)
    recorded = [one.pair for one in Records(out)]
    assert recorded == [str(i) for i in range(len(recorded))]
    assert 0 < len(recorded) < COUNT
    assert {name.split("_")[0] for name in results(out)} == set(recorded)
    assert not (out / ".unfinished").exists()
    assert told(pairs, out) == {str(i): "done" if str(i) in recorded else "matched" for i in range(COUNT)}


def test_results_in_memory_are_few(pairs, tmp_path, monkeypatch):
    many = write_pairs(tmp_path / "many", 24, np.random.default_rng(1))
    lock, held, most = threading.Lock(), 0, 0

    class Counting(Brightness):
        def forward(self, left, right):
            nonlocal held, most
            with lock:
                held += 1
                most = max(most, held)
            return super().forward(left, right)

    def tell(pair, outcome):
        nonlocal held
        with lock:
            held -= 1

    match_files(many, Predictor(Counting(), device="cpu"), tmp_path / "out", workers=1, tell=tell)
    # two wait to be told, one is computed, and one made the network ready
    assert most <= 4


def test_what_can_not_be_is_refused_before_anything_is_written(pairs, tmp_path):
    out = tmp_path / "out"
    for numbers in ({"workers": -1}, {"processes": 0}):
        with pytest.raises(ConfigError, match="at least 0 workers and 1 process"):
            match_files(pairs, open_brightness, out, **numbers)
    with pytest.raises(ConfigError, match="need a function that opens the network"):
        match_files(pairs, open_brightness(None), out, processes=2)
    with pytest.raises(InputError, match="two pairs have one name"):
        match_files([*pairs, pairs[0]], open_brightness, out)
    assert not out.exists()


def open_nothing(device):
    raise ConfigError("no such network")


@pytest.mark.slow
def test_processes_share_the_pairs_and_give_the_same_to_the_bit(pairs, tmp_path):
    pairs[1].right.write_bytes(b"broken")
    alone = told(pairs, tmp_path / "alone", workers=0)
    assert told(pairs, tmp_path / "out", processes=2) == alone
    assert results(tmp_path / "out") == results(tmp_path / "alone")
    assert told(pairs, tmp_path / "out", processes=2) == {
        name: word if name == "1" else "done" for name, word in alone.items()
    }
    with pytest.raises(ConfigError, match="no such network"):
        told(pairs, tmp_path / "none", predictor=open_nothing, processes=2)
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_process_that_is_killed_is_told_and_the_next_run_goes_on(pairs, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"one of 2 processes that match pairs was killed by signal 9: .*memory"):
        match_files(pairs, open_killed, out, processes=2)
    assert not multiprocessing.active_children()
    said = told(pairs, out)
    assert set(said.values()) <= {"done", "matched"}
    assert results(out) == results_of(pairs, tmp_path / "alone")


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(pairs, tmp_path):
    out = tmp_path / "out"
    program = f"""
from stereokit.batch import match_files
from stereokit.data.pairs import match_pairs
from tests.batch.opening import open_killed
match_files(match_pairs({str(tmp_path / "in/left")!r}, {str(tmp_path / "in/right")!r}), open_killed, {str(out)!r})
"""
    killed = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert killed.returncode == -9
    recorded = {one.pair for one in Records(out)}
    assert len(recorded) < COUNT
    assert told(pairs, out) == {pair.name: "done" if pair.name in recorded else "matched" for pair in pairs}
    assert results(out) == results_of(pairs, tmp_path / "alone")
    assert not (out / ".unfinished").exists()


def results_of(pairs, folder):
    match_files(pairs, open_brightness, folder, workers=0)
    return results(folder)


def test_a_kill_between_record_and_files_is_noticed(pairs, tmp_path):
    out = tmp_path / "out"
    told(pairs, out)
    whole = results(out)
    # the record of the last pair is there, its files are not; that of the one before is cut short
    text = (out / MANIFEST_NAME).read_bytes()
    lines = text.splitlines(keepends=True)
    (out / MANIFEST_NAME).write_bytes(b"".join(lines[:4]) + lines[4][:50])
    for name in ("3_disparity.png", "4_disparity.png", "4_disparity.pfm", "4_disparity.npz", "4_picture.png"):
        (out / name).unlink()
    (out / ".unfinished").mkdir()
    (out / ".unfinished" / "4_disparity.png").write_text("half")
    assert told(pairs, out) == dict.fromkeys("012", "done") | {
        "3": "again: 3_disparity.png is missing or damaged",
        "4": "matched",
    }
    assert results(out) == whole


def test_a_network_of_another_shape_is_another_setting(pairs, tmp_path):
    class Other(Brightness):
        pass

    told(pairs, tmp_path / "out")
    with pytest.raises(InputError, match=r"other settings \(another network\)"):
        told(pairs, tmp_path / "out", predictor=Predictor(Other(), device="cpu"))
