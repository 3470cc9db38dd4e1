import http.client
import io
import json
import socket
import threading
import zipfile
from contextlib import contextmanager
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stereokit import InputError, Predictor, build_model
from stereokit.data import read_image
from stereokit.data.pairs import match_pairs
from stereokit.errors import ConfigError
from stereokit.inference import DisparityResult
from stereokit.viewer import Album, Desk, Frames, ViewServer
from stereokit.viewer.desk import KEPT
from stereokit.viewer.server import host_is_allowed
from stereokit.viewer.shot import Shot
from stereokit.viewer.sources import find_results
from stereokit.viewer.standalone import PAGE_FILES
from tests.viewer.scenes import CAMERA, HEIGHT, WIDTH, Columns, confidence, disparity, save_pairs


class Reply(NamedTuple):
    status: int
    content: bytes
    headers: dict

    @property
    def json(self):
        return json.loads(self.content)

    @property
    def head(self):
        return json.loads(self.content[4 : 4 + int.from_bytes(self.content[:4], "little")])


class Client:
    def __init__(self, server):
        self.port = server.server_address[1]

    def __call__(self, path, *, method="GET", **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.putrequest(method, path, skip_host="Host" in named)
        for name, value in named.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return Reply(answer.status, content, {name.lower(): value for name, value in answer.getheaders()})


@contextmanager
def served(desk):
    with ViewServer(desk, port=0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield Client(server)
        finally:
            server.shutdown()
            thread.join()
            desk.close()


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return save_pairs(tmp_path_factory.mktemp("pairs") / "scene")


def saved(pairs):
    return Album(pairs, find_results(pairs[0].left.parent / "results", pairs))


@pytest.fixture(scope="module")
def ask(pairs):
    with served(Desk(saved(pairs), None, CAMERA)) as client:
        yield client


@pytest.fixture(scope="module")
def matched(pairs):
    with served(Desk(Album(pairs), Predictor(Columns(), "cpu"))) as client:
        yield client


def test_a_saved_result_arrives_as_it_is(ask, pairs):
    facts = ask("/entry?index=1").json
    assert (facts["name"], facts["width"], facts["height"], facts["seconds"]) == ("b", WIDTH, HEIGHT, None)
    at = f"/shot/{facts['number']}/"
    values = np.frombuffer(ask(at + "disparity").content, "<f4").reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(values, disparity())
    certainty = np.frombuffer(ask(at + "confidence").content, "<u2").reshape(HEIGHT, WIDTH) / 65535
    np.testing.assert_allclose(certainty, confidence(), atol=1 / 65535)
    for view in ("left", "right"):
        encoded = np.frombuffer(ask(at + view).content, np.uint8)
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[:, :, ::-1]
        np.testing.assert_array_equal(image, read_image(getattr(pairs[1], view)))


def test_the_page_knows_the_calibration(ask):
    facts = ask("/facts").json
    assert facts["calibration"] == CAMERA.to_dict()
    assert facts["entries"] == ["a", "b"]
    assert facts["stream"] is None
    assert not facts["matching"]
    assert len(bytes.fromhex(facts["colors"]["turbo"])) == 768


def test_a_saved_frame_is_opened_again(ask, tmp_path):
    number = ask("/entry?index=0").json["number"]
    reply = ask(f"/shot/{number}/archive")
    assert reply.headers["content-disposition"] == 'attachment; filename="a.zip"'
    with zipfile.ZipFile(io.BytesIO(reply.content)) as archive:
        archive.extractall(tmp_path)
    assert json.loads((tmp_path / "calibration.json").read_text()) == CAMERA.to_dict()
    again = match_pairs(tmp_path / "left.png", tmp_path / "right.png")
    desk = Desk(Album(again, find_results(tmp_path, again)))
    np.testing.assert_array_equal(desk.entry(0).result.disparity, disparity())
    np.testing.assert_array_equal(desk.entry(0).result.confidence, confidence())


def test_pairs_are_matched_on_request_and_once(matched):
    first = matched("/entry?index=0").json
    assert first["seconds"] > 0
    assert first["confidence"] == pytest.approx(0.75)
    assert matched("/entry?index=0").json["number"] == first["number"]
    values = np.frombuffer(matched(f"/shot/{first['number']}/disparity").content, "<f4").reshape(HEIGHT, WIDTH)
    assert set(np.unique(values[:, :40])) == {4.0}


def test_occlusion_is_where_the_views_disagree(matched):
    number = matched("/entry?index=0").json["number"]
    occluded = np.frombuffer(matched(f"/shot/{number}/occluded").content, np.uint8).reshape(HEIGHT, WIDTH)
    # the right view, matched in the mirror, has 8 px up to its column 39: of columns 40 to 47 of the left one
    seen = np.zeros((HEIGHT, WIDTH), np.uint8)
    seen[:, 40:48] = 1
    np.testing.assert_array_equal(occluded, 1 - seen)


def test_the_distribution_is_that_of_the_network(pairs):
    torch.manual_seed(0)
    predictor = Predictor(build_model("coex", max_disparity=64), "cpu")
    with served(Desk(Album(pairs), predictor)) as ask:
        number = ask("/entry?index=0").json["number"]
        values = np.frombuffer(ask(f"/shot/{number}/distribution?x=30&y=20").content, "<f4")
        expectation, spread, candidates = values[0], values[1], values[2:].reshape(-1, 3)
        assert ask(f"/shot/{number}/distribution?x={WIDTH}&y=0").status == 422
        assert ask(f"/shot/{number}/distribution?x=1").status == 400
    left, right = (read_image(getattr(pairs[0], view)) for view in ("left", "right"))
    expected = predictor.distributions(left, right).at([20], [30])
    np.testing.assert_allclose(candidates[:, 0], expected.disparities[0])
    np.testing.assert_allclose(candidates[:, 1], expected.probabilities[0], rtol=1e-4, atol=1e-6)
    assert candidates[:, 2].sum() == 2
    assert expectation == pytest.approx(expected.expectation[0], rel=1e-4)
    assert spread == pytest.approx(expected.spread[0], rel=1e-3)


def test_what_is_not_there_says_why(ask, matched):
    number = ask("/entry?index=0").json["number"]
    assert "saved result" in ask(f"/shot/{number}/occluded").content.decode()
    reply = matched(f"/shot/{matched('/entry?index=0').json['number']}/distribution?x=1&y=1")
    assert (reply.status, b"no distribution" in reply.content) == (404, True)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/entry?index=2", 422),
        ("/entry?index=-1", 400),
        ("/entry?index=x", 400),
        ("/entry?index=1" + "&a=1" * 20, 400),
        ("/entry", 400),
        ("/next?after=-1", 422),
        ("/shot/999/left", 410),
        ("/shot/1/nothing", 404),
        ("/shot/-1/left", 404),
        ("/nothing", 404),
        ("/server.py", 404),
        ("/../server.py", 404),
        ("/..%2fserver.py", 404),
        ("/page/../../server.py", 404),
        ("//etc/passwd", 404),
        ("/%00", 404),
        ("/[", 404),
        ("http:/[", 404),
    ],
)
def test_requests_for_what_is_not_there(ask, path, status):
    reply = ask(path)
    assert reply.status == status
    assert reply.headers["content-type"] == "text/plain; charset=utf-8"
    assert 0 < len(reply.content.decode().splitlines()[0]) == len(reply.content.decode())


def test_only_get_and_head(ask):
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask("/facts", method=method).status == 405
    whole, head = ask("/facts"), ask("/facts", method="HEAD")
    assert (head.status, head.content) == (200, b"")
    assert head.headers["content-length"] == str(len(whole.content))


def test_the_files_of_the_page(ask):
    page = ask("/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert "default-src 'self'" in page.headers["content-security-policy"]
    assert "http:" not in page.content.decode()
    assert "https:" not in page.content.decode()
    for name in PAGE_FILES:
        assert ask(f"/{name}").status == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "a b", "127.0.0.1@x"]
)
def test_other_hosts_are_refused(ask, host):
    assert ask("/facts", Host=host).status == 403
    assert ask("/", Host=host).status == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:9999", "LOCALHOST", "[::1]:80"])
def test_this_machine_is_served(ask, host):
    assert ask("/facts", Host=host).status == 200


def test_other_sites_get_nothing(ask):
    assert ask("/facts", Sec_Fetch_Site="cross-site").status == 403
    assert ask("/facts", Sec_Fetch_Site="same-origin").status == 200


@given(st.lists(st.text("abz09-", min_size=1, max_size=5), min_size=1, max_size=4))
def test_no_name_but_those_of_this_machine_passes(words):
    name = "evil." + ".".join(words)
    assert not host_is_allowed(name, "127.0.0.1")
    assert not host_is_allowed(f"{name}:8765", "127.0.0.1")
    assert host_is_allowed(name, name)


def test_a_port_in_use_is_one_line(pairs):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match=r"port \d+ is in use; choose another"):
            ViewServer(Desk(saved(pairs)), port=taken.getsockname()[1])
    with pytest.raises(InputError, match="expected 0 to 65535"):
        ViewServer(Desk(saved(pairs)), port=70000)
    with pytest.raises(InputError, match="--host is an address of this machine"):
        ViewServer(Desk(saved(pairs)), host="no.such.host.invalid", port=0)


class Video:
    """Frames that are counted, and an end or an error after them."""

    def __init__(self, count, error=None):
        self.index, self.count, self.error = -1, count, error

    def __iter__(self):
        return self

    def __next__(self):
        if self.index + 1 == self.count:
            raise self.error or StopIteration
        self.index += 1
        image = np.full((HEIGHT, WIDTH, 3), self.index, np.uint8)
        return type("Frame", (), {"left": image, "right": image, "index": self.index})


def stream(count, error=None):
    return Desk(Frames(Video(count, error), name="clip", live=False), Predictor(Columns(), "cpu"))


def test_every_frame_of_a_video_comes_once_and_then_the_end():
    with served(stream(3)) as ask:
        seen = [ask("/next?after=-1").head]
        for _ in range(3):
            seen.append(ask(f"/next?after={seen[-1]['number']}").head)
        assert seen[-1]["ended"]
        assert [facts["name"] for facts in seen[:-1]] == [f"clip, frame {i}" for i in range(3)]
        # another page gets the newest, and takes none away
        assert ask("/next?after=-1").head == seen[2]
        image = ask(f"/shot/{seen[2]['number']}/left")
        assert image.headers["content-type"] == "image/jpeg"
        assert ask("/entry?index=0").status == 422


@pytest.mark.parametrize(("largest", "steps"), [(200.0, 256), (400.0, 64)])
def test_a_frame_arrives_in_one_answer(largest, steps):
    rng = np.random.default_rng(0)
    values = rng.uniform(0, largest, (HEIGHT - 1, WIDTH - 1)).astype(np.float32)
    values[0, 0] = largest
    values[2, 3] = np.nan
    certainty = rng.random(values.shape, np.float32)
    image = np.tile(rng.integers(0, 256, (1, WIDTH - 1, 1), np.uint8), (HEIGHT - 1, 1, 3))
    shot = Shot(7, "clip", image, image[:, ::-1], DisparityResult(values, certainty, 0.1), lossless=False)
    packed = Reply(200, shot.packed(), {})
    head, at = packed.head, 4 + int.from_bytes(packed.content[:4], "little")
    assert (head["number"], head["width"], head["height"], at % 4) == (7, WIDTH - 1, HEIGHT - 1, 0)
    parts = {}
    for name, length in head["parts"].items():
        parts[name] = packed.content[at : at + length]
        at += length
    assert at == len(packed.content)
    assert head["steps"] == steps
    codes = np.frombuffer(parts["disparity"], "<u2").reshape(values.shape)
    found = np.where(codes == 0, np.nan, (codes - 1.0) / steps)
    np.testing.assert_allclose(found, values, atol=0.51 / steps)
    levels = np.frombuffer(parts["confidence"], np.uint8).reshape(values.shape)
    np.testing.assert_allclose(levels / 255, certainty, atol=0.51 / 255)
    for name, view in (("left", image), ("right", image[:, ::-1])):
        decoded = cv2.imdecode(np.frombuffer(parts[name], np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        assert np.abs(decoded.astype(int) - view).mean() < 12


def test_a_video_that_breaks_off_says_so():
    with served(stream(1, InputError("clip ends after 1 whole frame"))) as ask:
        number = ask("/next?after=-1").head["number"]
        reply = ask(f"/next?after={number}")
        assert (reply.status, reply.content) == (422, b"clip ends after 1 whole frame")


def test_old_frames_are_forgotten():
    with served(stream(KEPT + 2)) as ask:
        number = -1
        for _ in range(KEPT + 1):
            number = ask(f"/next?after={number}").head["number"]
        assert ask(f"/shot/{number}/disparity").status == 200
        assert ask("/shot/1/disparity").status == 410


def test_a_calibration_of_another_size_is_refused(pairs):
    other = CAMERA.scaled(height=2 * HEIGHT, width=2 * WIDTH)
    with served(Desk(saved(pairs), None, other)) as ask:
        reply = ask("/entry?index=0")
        assert (reply.status, b"160 x 96" in reply.content) == (422, True)


def test_results_that_do_not_fit(pairs, tmp_path):
    with pytest.raises(InputError, match="one file for 2 pairs"):
        find_results(pairs[0].left, pairs)
    with pytest.raises(InputError, match="no disparity of the pair 'a'"):
        find_results(tmp_path, pairs)
    with pytest.raises(InputError, match="does not exist"):
        find_results(tmp_path / "absent", pairs[:1])
    np.savez(tmp_path / "small.npz", disparity=np.ones((2, 3), np.float32))
    with pytest.raises(InputError, match="is 3 x 2 pixels, the left image 80 x 48"):
        Desk(Album(pairs[:1], [tmp_path / "small.npz"])).entry(0)
    with pytest.raises(ConfigError, match="need a predictor"):
        Desk(Album(pairs))
