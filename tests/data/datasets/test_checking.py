import os

import numpy as np

from stereokit.data.datasets import check_dataset, format_report, open_dataset
from tests.data.datasets import trees


def test_a_whole_data_set(tmp_path):
    trees.kitti2015(tmp_path, range(3))
    report = check_dataset(open_dataset(f"kitti2015:{tmp_path}"))
    assert (
        report.pairs,
        report.with_truth,
        report.with_nonocc,
        report.with_objects,
        report.with_calibration,
    ) == ((3,) * 5)
    assert report.sizes == {(9, 6): 3}
    assert (report.lowest, report.highest) == (4, 4)
    assert report.density == 6 / 9
    assert report.broken == []
    text = format_report(report)
    for part in ("kitti2015, split 'training'", "9 x 6 (3)", "4.00 to 4.00 pixels", "66.7% of the pixels"):
        assert part in text


def test_what_is_broken_is_named(tmp_path):
    trees.kitti2012(tmp_path, range(5))
    training = tmp_path / "training"
    (training / "image_1" / "000000_10.png").unlink()
    (training / "image_0" / "000001_10.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (training / "disp_occ" / "000002_10.png").unlink()
    trees.save(training / "disp_occ" / "000002_10.png", trees.stored(256)[:, :5])
    (training / "calib" / "000003.txt").write_text("")
    report = check_dataset(open_dataset(f"kitti2012:{tmp_path}", allow_missing=True))
    assert report.pairs == 5
    assert [name for name, _ in report.broken] == [f"00000{number}_10" for number in range(4)]
    for (_, message), part in zip(
        report.broken, ("does not exist", "broken image", "one size", "cameras"), strict=True
    ):
        assert part in message
    assert sum(report.sizes.values()) == 1
    text = format_report(report, most=1)
    assert "broken            4" in text
    assert "and 3 more" in text


def test_without_truth_nothing_is_claimed(tmp_path):
    trees.kitti2012(tmp_path, part="testing")
    report = check_dataset(open_dataset(f"kitti2012/testing:{tmp_path}"))
    assert report.density is report.lowest is report.highest is report.sparsest is None
    assert "disparity  " not in format_report(report)


def test_truth_that_is_all_unknown(tmp_path):
    trees.kitti2012(tmp_path, range(1))
    (tmp_path / "training" / "disp_occ" / "000000_10.png").unlink()
    trees.save(tmp_path / "training" / "disp_occ" / "000000_10.png", np.zeros((6, 9), np.uint16))
    report = check_dataset(open_dataset(f"kitti2012:{tmp_path}"))
    assert report.density == 0
    assert report.lowest is None
    assert "known disparity   0.0%" in format_report(report)


def test_the_sparsest_and_the_range(tmp_path):
    trees.kitti2012(tmp_path, range(3))
    for number, value in ((0, 0.5), (1, 7.0)):
        path = tmp_path / "training" / "disp_occ" / f"00000{number}_10.png"
        path.unlink()
        values = np.full(trees.SHAPE, np.nan)
        values[: 3 - 2 * number] = value
        trees.save(path, trees.stored(256, disparity=values))
    report = check_dataset(open_dataset(f"kitti2012:{tmp_path}"))
    assert report.sparsest == ("000001_10", 1 / 6)
    assert (report.lowest, report.highest) == (0.5, 7)
    assert report.density == (27 + 9 + 36) / 162


def test_progress_sees_every_pair(tmp_path):
    trees.kitti2012(tmp_path, range(3))
    seen = []

    def watch(entries):
        for entry in entries:
            seen.append(entry.name)
            yield entry

    check_dataset(open_dataset(f"kitti2012:{tmp_path}"), progress=watch)
    assert len(seen) == 3


def test_what_is_odd_is_counted(tmp_path):
    for number in range(2):
        trees.save(tmp_path / "left" / f"{number}.png", trees.picture(shape=(40, 40)))
        trees.save(tmp_path / "right" / f"{number}.png", np.full((40, 40), 4095, np.uint16))
        trees.save(tmp_path / "disparity" / f"{number}.pfm", np.where(np.eye(40), 16, 160).astype(np.float32))
    report = check_dataset(open_dataset(f"folder:{tmp_path}"))
    assert set(report.warnings.values()) == {2}
    text = format_report(report)
    for part in ("need 12 bits only", "one image of a pair has 8 bits", "all disparities are multiples of 16"):
        assert part in text
    assert "(2 pairs)" in text


def test_names_in_a_report_are_printable(tmp_path):
    name = os.fsdecode(b"a\x1b[31m\xff")
    trees.save_pair(tmp_path / "left" / f"{name}.png", tmp_path / "right" / f"{name}.png")
    (tmp_path / "left" / f"{name}.png").write_bytes(b"no picture")
    text = format_report(check_dataset(open_dataset(f"folder:{tmp_path}")))
    text.encode()
    assert text.replace("\n", "").isprintable()
