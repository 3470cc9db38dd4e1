import os

import pytest

from stereokit.errors import InputError
from stereokit.files import atomic_path


def test_the_file_appears_whole(tmp_path):
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("content")
        assert temporary.suffix == ".txt"
        assert temporary.parent == tmp_path
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "content"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failure_leaves_nothing_and_harms_nothing(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def fail_halfway():
        with atomic_path(tmp_path / "a.txt", overwrite=True) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_an_existing_file_is_kept_unless_told(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with (
        pytest.raises(InputError, match=r"a\.txt' exists already.*overwrite=True"),
        atomic_path(tmp_path / "a.txt"),
    ):
        pytest.fail("the block must not run")
    with atomic_path(tmp_path / "a.txt", overwrite=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a.txt").read_text() == "new"


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    def race():
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("mine")
            (tmp_path / "a.txt").write_text("theirs")

    with pytest.raises(InputError, match="exists already"):
        race()
    assert (tmp_path / "a.txt").read_text() == "theirs"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real" / "a.txt")
    with atomic_path(tmp_path / "link.txt", overwrite=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"


def test_no_folder_and_no_file(tmp_path):
    with (
        pytest.raises(InputError, match=r"the folder .*absent' does not exist"),
        atomic_path(tmp_path / "absent" / "a"),
    ):
        pass
    with pytest.raises(InputError, match="not a regular file"), atomic_path(tmp_path, overwrite=True):
        pass


def test_a_failing_write_is_reported(tmp_path):
    with pytest.raises(InputError, match="can't be written"), atomic_path(tmp_path / "a.txt"):
        pass  # nothing was written, so there is nothing to rename
