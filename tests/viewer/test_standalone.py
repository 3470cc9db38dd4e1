import base64
import json
import re
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from stereokit import InputError, Predictor, build_model
from stereokit.viewer import Album, Desk, Frames, write_page
from stereokit.viewer.packing import DISPARITY_STEPS, pack_map, quantised
from stereokit.viewer.sources import find_results
from tests.viewer.scenes import CAMERA, HEIGHT, WIDTH, Columns, disparity, save_pairs


def unpacked(text, height, width):
    """The inverse of `pack_map`, as the page has it."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(2, height, width).astype(np.int64)
    steps = planes[0] + 256 * planes[1]
    steps[:, 0] = np.cumsum(steps[:, 0])
    return (np.cumsum(steps, axis=1) % 65536).astype(np.uint16)


def held(page):
    return json.loads(re.search(r'id="embedded">(.*?)</script>', page, re.S)[1])


@given(arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_maps_come_back(codes):
    np.testing.assert_array_equal(unpacked(pack_map(codes), *codes.shape), codes)


@given(st.lists(st.floats(0, 1000, width=32) | st.just(float("nan")), min_size=1, max_size=20))
def test_disparity_is_held_to_half_a_step(values):
    given_values = np.array([values], np.float32)
    codes = quantised(given_values)
    np.testing.assert_array_equal(codes == 0, np.isnan(given_values))
    known = codes > 0
    error = (codes[known].astype(np.float64) - 1) / DISPARITY_STEPS - given_values[known]
    assert (np.abs(error) <= 0.5 / DISPARITY_STEPS + 1e-9).all()


def test_a_page_holds_all_pairs_and_asks_nobody(tmp_path):
    pairs = save_pairs(tmp_path / "scene", names=("a", "b <script><b>"))
    desk = Desk(Album(pairs, find_results(tmp_path / "scene" / "results", pairs)), None, CAMERA)
    size = write_page(tmp_path / "page.html", desk)
    page = (tmp_path / "page.html").read_text()
    assert size == len(page.encode())
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "fetch" in page
    assert "http:" not in page.replace("http://www.w3.org", "")
    facts = held(page)
    assert facts["entries"] == ["a", "b <script><b>"]
    shot = facts["shots"][0]
    codes = unpacked(shot["disparity"], HEIGHT, WIDTH)
    np.testing.assert_allclose(np.where(codes, (codes - 1.0) / shot["steps"], np.nan), disparity())
    assert (shot["distributions"], shot["occluded"]) == (None, None)
    with pytest.raises(InputError, match="exists already"):
        write_page(tmp_path / "page.html", desk)
    assert write_page(tmp_path / "page.html", desk, overwrite=True) == size


def test_distributions_are_held_at_a_grid(tmp_path, monkeypatch):
    monkeypatch.setattr("stereokit.viewer.standalone.GRID_POINTS", 60)
    pairs = save_pairs(tmp_path / "scene", names=("a",))
    torch.manual_seed(0)
    predictor = Predictor(build_model("coex", max_disparity=64), "cpu")
    write_page(tmp_path / "page.html", Desk(Album(pairs), predictor))
    shot = held((tmp_path / "page.html").read_text())["shots"][0]
    grid = shot["distributions"]
    assert (grid["step"], grid["rows"], grid["columns"], grid["candidates"]) == (8, 6, 10, 16)

    def array(name, kind):
        return np.frombuffer(zlib.decompress(base64.b64decode(grid[name])), kind)

    x, y, cell = 4 + 3 * 8, 4 + 2 * 8, 2 * 10 + 3
    expected = predictor.distributions(pairs[0].left, pairs[0].right).at([y], [x])
    probabilities = array("probabilities", "<u2").reshape(-1, 16)[cell] / 65535 * array("peaks", "<f4")[cell]
    np.testing.assert_allclose(probabilities, expected.probabilities[0], atol=1e-4)
    np.testing.assert_allclose(array("disparities", "<f4"), expected.disparities[0])
    np.testing.assert_array_equal(array("kept", np.uint8).reshape(-1, 16)[cell], expected.kept[0])
    bits = np.unpackbits(np.frombuffer(zlib.decompress(base64.b64decode(shot["occluded"])), np.uint8))
    assert bits.size == HEIGHT * WIDTH


def test_a_network_without_distributions_leaves_them_out(tmp_path):
    pairs = save_pairs(tmp_path / "scene", names=("a",))
    write_page(tmp_path / "page.html", Desk(Album(pairs), Predictor(Columns(), "cpu")))
    assert held((tmp_path / "page.html").read_text())["shots"][0]["distributions"] is None


def test_what_a_page_can_not_hold(tmp_path):
    desk = Desk(Frames([], name="clip", live=False), Predictor(Columns(), "cpu"))
    with pytest.raises(InputError, match="not the frames of a video"):
        write_page(tmp_path / "page.html", desk)
    pairs = save_pairs(tmp_path / "scene", names=("a",)) * 25
    with pytest.raises(InputError, match="at most 24 pairs, got 25"):
        write_page(tmp_path / "page.html", Desk(Album(pairs), Predictor(Columns(), "cpu")))
    assert not (tmp_path / "page.html").exists()
