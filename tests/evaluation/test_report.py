import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from stereokit.errors import InputError
from stereokit.evaluation import Report, evaluate
from stereokit.evaluation.report import worst_first
from stereokit.evaluation.results import PairResult
from tests.evaluation.scenes import SIZE, constant, save_kitti, save_scene

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
COUNT_PICTURES = """<script>addEventListener("load", () => {
  const images = [...document.images];
  document.body.dataset.pictures = images.length;
  document.body.dataset.loaded = images.filter(image => image.complete && image.naturalWidth > 0).length;
});</script>"""


def written(tmp_path, matcher=None, **options):
    """A report over scenes of 9, 6, 12 px and of KITTI without ground truth, by a matcher that always says 7."""
    for name, disparity in (("mild", 9), ("good <b>&lt;", 6), ("worst", 12)):
        save_scene(tmp_path / "mine", name, disparity)
    save_kitti(tmp_path / "kitti", "2012", "testing", [3])
    report = Report(tmp_path / "report", **options)
    datasets = [f"folder:{tmp_path / 'mine'}", f"kitti2012/testing:{tmp_path / 'kitti'}"]
    evaluation = evaluate(matcher or constant(7.0), datasets, observers=[report])
    return report.save(evaluation)


class Page(HTMLParser):
    """The texts of some elements, and everything that the page refers to."""

    def __init__(self, html):
        super().__init__()
        self.texts, self.references, self.open = {}, [], []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        self.references += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]
        if tag not in ("meta", "img"):
            self.open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag):
        self.open.remove(tag)

    def handle_data(self, data):
        for tag in set(self.open):
            self.texts[tag][-1] += data


def test_pairs_come_worst_first_with_their_pictures(tmp_path):
    html = written(tmp_path).read_text()
    page = Page(html)
    names = [re.search(r"\d+ (.*?) (?:D1|no ground truth)", text)[1].strip() for text in page.texts["h4"]]
    assert names == ["worst", "mild", "good <b>&lt;", "000003_10"]
    figures = [text.split()[0] for text in page.texts["figcaption"]]
    assert figures == ["Left", "Ground", "Prediction", "Error"] * 3 + ["Left", "Prediction"]
    rows = [cell for cell in page.texts["td"] if cell in names]
    assert rows == names


def test_the_page_holds_everything_it_shows(tmp_path):
    html = written(tmp_path).read_text()
    references = Page(html).references
    assert references
    assert all(ref.startswith(("data:image/", "#pair-")) for ref in references)
    assert all(f'id="{ref[1:]}"' in html for ref in references if ref.startswith("#"))
    assert "http" not in re.sub(r'http-equiv|data:image/[^"]*', "", html)


@pytest.mark.parametrize("most", [0, 1, 2])
def test_only_the_worst_are_shown_and_all_have_a_row(tmp_path, most):
    html = written(tmp_path, most=most).read_text()
    headings = Page(html).texts.get("h4", [])
    assert [text.split()[1] for text in headings] == ["worst", "mild"][:most] + ["000003_10"][:most]
    assert f"Pictures of the worst {most} of 3." in html
    page = Page(html)
    assert {"worst", "mild", "good <b>&lt;"} <= set(page.texts["td"])


def test_holes_and_empty_truth_are_said(tmp_path):
    html = written(tmp_path, lambda left, right: np.full(SIZE, np.nan)).read_text()
    assert "100.0 % of the pixels not predicted" in html
    assert "EPE no pixels" in html
    assert "no ground truth" in html


def test_an_existing_page_is_kept_unless_told_otherwise(tmp_path):
    (tmp_path / "index.html").write_text("precious")
    with pytest.raises(InputError, match="exists already"):
        Report(tmp_path)
    Report(tmp_path, overwrite=True)
    assert (tmp_path / "index.html").read_text() == "precious"


def test_pairs_without_numbers_come_last():
    def pair(name, **metrics):
        return PairResult(name, 6, 4, 0.1, 0, metrics or None)

    pairs = [
        pair("none"),
        pair("empty", d1=None, epe=None),
        pair("right", d1=0.0, epe=0.1),
        pair("bad", d1=50.0, epe=4.0),
        pair("holes", d1=50.0, epe=None),
    ]
    assert [p.name for p in sorted(pairs, key=worst_first)] == ["bad", "holes", "right", "none", "empty"]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_browser_shows_it_from_disk(tmp_path):
    html = written(tmp_path).read_text()
    # the page itself forbids scripts: this one is let in by the copy's policy alone
    policy = "default-src 'none'; "
    assert policy in html
    copy = tmp_path / "copy.html"
    copy.write_text(html.replace(policy, policy + "script-src 'unsafe-inline'; ").replace("</body>", COUNT_PICTURES))
    command = [CHROMIUM, *QUIET, f"--user-data-dir={tmp_path / 'browser'}", "--dump-dom", copy.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    pictures, loaded = (int(re.search(rf'data-{name}="(\d+)"', shown)[1]) for name in ("pictures", "loaded"))
    assert pictures == loaded == 3 * 4 + 2
    page = Page(shown)
    assert (
        page.texts["title"]
        == page.texts["h1"]
        == ["Stereo evaluation: tests.evaluation.scenes.constant.<locals>.match"]
    )
    assert [text.split()[1] for text in page.texts["h4"]] == ["worst", "mild", "good", "000003_10"]
    assert len(page.texts["article"]) == 4
