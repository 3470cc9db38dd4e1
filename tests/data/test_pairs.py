from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit import InputError
from stereokit.data.pairs import match_pairs

names = st.lists(st.text("abcXYZ019", min_size=1, max_size=5), min_size=1, max_size=5, unique_by=str.lower)


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_two_files_are_one_pair_whatever_their_names(tmp_path: Path) -> None:
    touch(tmp_path / "a/first.png", tmp_path / "b/second.jpg")
    (pair,) = match_pairs(tmp_path / "a/first.png", tmp_path / "b/second.jpg")
    assert (pair.name, pair.left, pair.right) == ("first", tmp_path / "a/first.png", tmp_path / "b/second.jpg")
    with pytest.raises(InputError, match=r"third\.png' does not exist"):
        match_pairs(tmp_path / "a/first.png", tmp_path / "b/third.png")


def test_pairs_have_names_of_their_own(tmp_path: Path) -> None:
    touch(*(tmp_path / f"{side}{name}.png" for side in "LR" for name in ("a", "a_", "c")))
    assert [pair.name for pair in match_pairs(tmp_path / "L*.png", tmp_path / "R*.png")] == ["a", "a_", "c"]


@given(names)
def test_folders_are_matched_by_name(tmp_path_factory: pytest.TempPathFactory, names: list[str]) -> None:
    root = tmp_path_factory.mktemp("pairs")
    touch(
        *(root / "l" / f"{n}.png" for n in names), *(root / "r" / f"{n}.jpg" for n in names), root / "l" / "notes.txt"
    )
    pairs = match_pairs(root / "l", root / "r")
    assert [pair.name for pair in pairs] == sorted(names)
    assert all(pair.left.stem == pair.right.stem == pair.name for pair in pairs)


@given(names)
def test_patterns_are_matched_by_what_the_wildcard_stands_for(
    tmp_path_factory: pytest.TempPathFactory, names: list[str]
) -> None:
    root = tmp_path_factory.mktemp("pairs")
    touch(*(root / f"{n}_{side}.png" for n in names for side in ("left", "right")))
    pairs = match_pairs(root / "*_left.png", root / "*_right.png")
    assert [pair.name for pair in pairs] == sorted(names)
    assert all(pair.right.name == f"{pair.name}_right.png" for pair in pairs)


def test_wildcards_may_stand_for_folders(tmp_path: Path) -> None:
    touch(*(tmp_path / scene / f"im{i}.png" for scene in ("a", "b") for i in (0, 1)))
    assert [p.name for p in match_pairs(tmp_path / "*/im0.png", tmp_path / "*/im1.png")] == ["a", "b"]
    touch(*(tmp_path / "deep" / "er" / f"im{i}.png" for i in (0, 1)))
    names = [p.name for p in match_pairs(tmp_path / "**/im0.png", tmp_path / "**/im1.png")]
    assert names == ["a", "b", "deep_er"]


def test_a_file_whose_name_looks_like_a_pattern_is_a_file(tmp_path: Path) -> None:
    touch(tmp_path / "a[1].png", tmp_path / "b[1].png")
    assert match_pairs(tmp_path / "a[1].png", tmp_path / "b[1].png")[0].name == "a[1]"


def test_images_without_a_partner_are_named(tmp_path: Path) -> None:
    touch(tmp_path / "l/a.png", tmp_path / "l/b.png", tmp_path / "r/a.png", tmp_path / "r/c.png")
    with pytest.raises(InputError, match=r"^2 images without a partner.*b\.png.*c\.png"):
        match_pairs(tmp_path / "l", tmp_path / "r")
    touch(tmp_path / "l/c.png")
    with pytest.raises(InputError, match=r"^1 image without a partner.*b\.png"):
        match_pairs(tmp_path / "l", tmp_path / "r")


def test_nothing_found_mixed_kinds_and_doubles_are_refused(tmp_path: Path) -> None:
    touch(tmp_path / "l/a.png", tmp_path / "r/a.png", tmp_path / "twice/a.png", tmp_path / "twice/a.jpg")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no images found at"):
        match_pairs(tmp_path / "empty", tmp_path / "r")
    with pytest.raises(InputError, match=r"is a folder and .* a file"):
        match_pairs(tmp_path / "l", tmp_path / "r/a.png")
    with pytest.raises(InputError, match="both stand for 'a'"):
        match_pairs(tmp_path / "twice", tmp_path / "r")


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    touch(*(tmp_path / side / "0001.png" for side in "lr"), tmp_path / "l/._0001.png", tmp_path / "l/._0002.png")
    assert [pair.name for pair in match_pairs(tmp_path / "l", tmp_path / "r")] == ["0001"]
    assert [pair.name for pair in match_pairs(tmp_path / "l/*.png", tmp_path / "r/*.png")] == ["0001"]


def test_a_pattern_that_can_not_be_understood(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"pattern .* can't be understood"):
        match_pairs(tmp_path / "[z-a]*.png", tmp_path / "b*.png")


def test_messages_are_short_and_printable(tmp_path: Path) -> None:
    touch(*(tmp_path / "l" / f"{number}\x1b[31m{'x' * 200}.png" for number in range(9)), tmp_path / "r/a.png")
    with pytest.raises(InputError, match="without a partner") as caught:
        match_pairs(tmp_path / "l", tmp_path / "r")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400
