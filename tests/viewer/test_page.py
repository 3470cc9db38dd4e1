"""The page in a browser, which is not everywhere."""

import contextlib
import shutil
import threading

import numpy as np
import pytest
import torch

from stereokit import Predictor, build_model
from stereokit.cameras.depth import depth_from_disparity, depth_standard_error
from stereokit.viewer import Album, Desk, Frames, ViewServer, write_page
from stereokit.viewer.sources import find_results
from tests.viewer.scenes import CAMERA, HEIGHT, WIDTH, Columns, disparity, save_pairs
from tests.viewer.test_server import Video

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRAWN = "() => window.app && app.frame && app.mapped.image && !app.drawing"
PICTURE = "() => { const {width, height, data} = app.dots; return [width, height, ...data.slice(0, 4)] }"
DOTS = """() => {
  app.cloud.seen = null;
  app.cloud.draw([0, 0, 0]);
  const {gl, canvas, points} = app.cloud, {width, height} = canvas;
  if (!gl) return points.context.getImageData(0, 0, width, height).data;
  const dots = new Uint8Array(4 * width * height), upright = new Uint8Array(dots.length);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, dots);
  const row = 4 * width;
  for (let y = 0; y < height; y++) upright.set(dots.subarray(row * y, row * (y + 1)), row * (height - 1 - y));
  return upright;
}"""
LIT = f"""() => {{
  const dots = ({DOTS})(), {{width, height}} = app.cloud.canvas;
  let lit = 0, sum = 0;
  for (let i = 0; i < dots.length; i += 4) if (dots[i] + dots[i + 1] + dots[i + 2]) {{ lit++; sum += i * dots[i]; }}
  return [lit / width / height, sum];
}}"""
WEBGL = """
const before = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  const found = before.call(this, name);
  return /swiftshader/i.test(found) ? "a card" : found;
};
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
]


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as api:
        opened = api.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--enable-unsafe-swiftshader"],
        )
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return save_pairs(tmp_path_factory.mktemp("pairs") / "scene")


@contextlib.contextmanager
def opened(browser, address, webgl=False, **options):
    page = browser.new_page(viewport={"width": 1200, "height": 800}, **options)
    page.set_default_timeout(60_000)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    if webgl:
        page.add_init_script(WEBGL)
    page.goto(address)
    page.wait_for_function(DRAWN)
    assert page.evaluate("() => app.cloud.gl !== null") == webgl
    yield page
    page.close()
    assert errors == []


@contextlib.contextmanager
def served(desk):
    with ViewServer(desk, port=0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server.url
        server.shutdown()
        thread.join()
        desk.close()


def point(page, canvas, x, y):
    """Where a pixel lies in the page."""
    return page.evaluate(
        """([id, x, y]) => {
          const canvas = document.getElementById(id), box = canvas.getBoundingClientRect();
          const {scale, left, top} = app.window.fit(canvas, app.frame.width, app.frame.height);
          const dots = canvas.width / box.width;
          return [box.left + (left + (x + 0.5) * scale) / dots, box.top + (top + (y + 0.5) * scale) / dots];
        }""",
        [canvas, x, y],
    )


def texts(page, *names):
    return [page.text_content(f"#{name}") for name in names]


def test_hovering_says_what_python_says(browser, pairs):
    desk = Desk(Album(pairs, find_results(pairs[0].left.parent / "results", pairs)), None, CAMERA)
    with served(desk) as url, opened(browser, url) as page:
        values = np.nan_to_num(disparity(), nan=4.0)
        depth = depth_from_disparity(values, CAMERA)
        error = depth_standard_error(values, CAMERA, 0.5)
        # two digits of the error
        for x, y, match, digits in ((20, 30, "x = 16.0", 2), (60, 10, "x = 52.0", 3), (1, 7, "outside", 2)):
            page.mouse.move(*point(page, "left", x, y))
            page.wait_for_function(f"() => document.getElementById('at').textContent === '{x}, {y}'")
            d, metres, where = texts(page, "disparity", "depth", "match")
            assert d == f"{values[y, x]:.2f} px"
            assert metres == f"{depth[y, x]:.{digits}f} m ± {error[y, x]:.{digits}f} m"
            assert where == match
        page.mouse.move(*point(page, "map", 5, 3))
        page.wait_for_function("() => document.getElementById('disparity').textContent === 'unknown'")
        assert texts(page, "depth", "match") == ["unknown", "unknown"]
        assert page.evaluate("() => app.right.marks.length") == 0
        page.mouse.click(*point(page, "left", 20, 30))
        assert "saved result" in page.text_content("#chart-note")
        assert page.is_disabled("#maps input[value=occlusion]")


def test_maps_ranges_and_pairs(browser, pairs):
    desk = Desk(Album(pairs, find_results(pairs[0].left.parent / "results", pairs)), None, CAMERA)
    with served(desk) as url, opened(browser, url) as page:
        first = page.evaluate(PICTURE)
        assert first[:2] == [WIDTH, HEIGHT]
        assert texts(page, "low-text", "high-text") == ["4.00 px", "8.00 px"]
        # the unknown pixel shows the image below
        assert page.evaluate(f"() => app.dots.data[4 * (3 * {WIDTH} + 5) + 3]") == 0
        page.keyboard.press("2")
        assert page.text_content("#map-title") == "Depth"
        assert page.evaluate(PICTURE) != first
        page.fill("#low", "900")
        low, high = (float(text.split()[0]) for text in texts(page, "low-text", "high-text"))
        assert low < high
        page.click("#fit")
        assert float(page.text_content("#low-text").split()[0]) < low
        page.fill("#least", "50")
        assert page.evaluate("() => app.dots.data[3]") == 0
        page.keyboard.press("]")
        page.wait_for_function("() => app.frame.name === 'b'")
        assert page.is_disabled("#next")
        with page.expect_download() as saved:
            page.click("#save-frame")
        assert saved.value.suggested_filename == "b.zip"
        with page.expect_download() as saved:
            page.click("#save-picture")
        assert saved.value.suggested_filename == "b_depth.png"


@pytest.mark.parametrize("step", [1, 3])
def test_both_ways_to_draw_points_give_one_picture(browser, pairs, step):
    desk = Desk(Album(pairs, find_results(pairs[0].left.parent / "results", pairs)), None, CAMERA)
    drawn = []
    with served(desk) as url:
        for webgl in (False, True):
            with opened(browser, url, webgl) as page:
                # as if it stood still, and near enough that points are large
                page.evaluate(
                    f"""() => {{
                      app.cloud.away *= 0.7;
                      app.cloud.draw = function (black) {{ this.points.draw(black, this.view, {step}); }};
                    }}"""
                )
                width = page.evaluate("() => app.cloud.canvas.width")
                drawn.append(np.array(page.evaluate(f"() => [...({DOTS})()]"), np.uint8).reshape(-1, width, 4))
    raster, card = drawn
    assert raster.shape == card.shape
    assert (card[..., :3] > 0).any(-1).mean() > 0.1
    # edges of points are rounded differently
    assert (np.abs(raster.astype(int) - card).max(-1) > 2).mean() < 0.02


@pytest.mark.parametrize("webgl", [True, False])
def test_the_cloud_turns_and_measures(browser, pairs, webgl):
    desk = Desk(Album(pairs, find_results(pairs[0].left.parent / "results", pairs)), None, CAMERA)
    with served(desk) as url, opened(browser, url, webgl) as page:
        share, before = page.evaluate(LIT)
        assert share > 0.1
        box = page.locator("#cloud").bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0] + 60, middle[1] + 20, steps=4)
        page.mouse.up()
        share, after = page.evaluate(LIT)
        assert share > 0.1
        assert after != before
        assert page.evaluate("() => app.cloud.yaw") == pytest.approx(0.3 - 60 / 200)
        ends = [(25, 20), (60, 30)]
        for x, y in ends:
            where = page.evaluate(
                f"""() => {{
                  const box = app.cloud.canvas.getBoundingClientRect(), dots = app.cloud.canvas.width / box.width;
                  const dot = app.cloud.projector()({x}, {y}, app.frame.disparity[{y} * app.frame.width + {x}]);
                  return [box.left + dot[0] / dots, box.top + dot[1] / dots];
                }}"""
            )
            page.mouse.click(*where)
        page.wait_for_function("() => document.getElementById('measured').textContent.startsWith('Distance')")
        depth = depth_from_disparity(np.nan_to_num(disparity(), nan=4.0), CAMERA)
        found = page.evaluate("() => app.cloud.ends.map(end => [end.x, end.y])")
        # the nearest point of those near the pointer
        assert np.abs(np.array(found) - ends).max() <= 3
        places = [
            np.array([(x - CAMERA.cx0) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1]) * depth[y, x] for x, y in found
        ]
        expected = np.linalg.norm(places[0] - places[1])
        assert page.text_content("#measured") == f"Distance {expected:.3f} m"


def test_a_click_shows_the_distribution_served_and_held(browser, pairs, tmp_path):
    torch.manual_seed(0)
    predictor = Predictor(build_model("coex", max_disparity=64), "cpu")
    desk = Desk(Album(pairs[:1]), predictor)
    with served(desk) as url, opened(browser, url) as page:
        page.mouse.click(*point(page, "left", 30, 20))
        page.wait_for_selector("#chart svg")
        assert page.locator("#chart .bar").count() == 16
        assert page.locator("#chart .kept").count() == 2
        estimate = desk.entry(0).result.disparity[20, 30]
        assert float(page.text_content("#chart .estimate-text").split()[0]) == pytest.approx(estimate, abs=0.06)
        said = page.text_content("#chart-note")
        assert "2 of 16 candidates kept" in said
        page.keyboard.press("4")
        page.wait_for_function("() => app.occluded")
        occluded = page.evaluate("() => [...app.occluded]")
    desk = Desk(Album(pairs[:1]), predictor)
    write_page(tmp_path / "page.html", desk)
    with opened(browser, (tmp_path / "page.html").as_uri()) as page:
        values = np.array(page.evaluate("() => [...app.frame.disparity]")).reshape(HEIGHT, WIDTH)
        np.testing.assert_allclose(values, desk.entry(0).result.disparity, atol=1 / 128 + 1e-6)
        page.mouse.click(*point(page, "left", 30, 20))
        page.wait_for_selector("#chart svg")
        assert page.locator("#chart .kept").count() == 2
        assert "This page holds every" in page.text_content("#chart-note")
        page.keyboard.press("4")
        page.wait_for_function("() => app.occluded")
        assert page.evaluate("() => [...app.occluded]") == occluded
    desk.close()


def test_a_stream_plays_pauses_and_ends(browser):
    desk = Desk(Frames(Video(4), name="clip", live=False), Predictor(Columns(), "cpu"))
    with served(desk) as url, opened(browser, url) as page:
        page.wait_for_function("() => app.frame.name === 'clip, frame 3'")
        page.wait_for_selector("#message:not([hidden])")
        assert page.text_content("#message") == "That was the last frame."
        assert page.text_content("#pause") == "Go on"


@pytest.mark.parametrize(("width", "scheme"), [(360, "dark"), (700, "light"), (1500, "dark")])
def test_nothing_is_wider_than_the_window(browser, pairs, width, scheme):
    desk = Desk(Album(pairs, find_results(pairs[0].left.parent / "results", pairs)), None, CAMERA)
    with served(desk) as url, opened(browser, url, color_scheme=scheme) as page:
        page.set_viewport_size({"width": width, "height": 700})
        assert page.evaluate("() => document.documentElement.scrollWidth") <= width
        unnamed = page.evaluate(
            """() => [...document.querySelectorAll("button, input, select, canvas[tabindex]")]
              .filter(element => !element.ariaLabel && !element.labels?.length && !element.textContent.trim())
              .map(element => element.id)"""
        )
        assert unnamed == []
