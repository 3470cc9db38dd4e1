"""The viewer's page in headless Chromium, as it runs on a machine without a graphics card."""

import os
import shutil
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from stereokit.viewer import Desk, ViewServer

KINDS = {
    "--type=renderer": "the page",
    "--type=gpu-process": "what is left to draw",
    "network.mojom": "the browser's network",
}
FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader"]
TICKS = os.sysconf("SC_CLK_TCK")
SOFTWARE_WEBGL = """
const before = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  const found = before.call(this, name);
  return /swiftshader/i.test(found) ? "a card" : found;
};
"""
"""Lets the page take WebGL, whoever draws it: here SwiftShader, in software."""


@contextmanager
def viewer_page(desk: Desk, *, width: int, height: int, webgl: bool = False) -> Iterator[Page]:
    """A page that looks at a desk; closes both in the end. `webgl`: in software too."""
    with ViewServer(desk, port=0) as server, sync_playwright() as api:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = api.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(120_000)
        if webgl:
            page.add_init_script(SOFTWARE_WEBGL)
        page.goto(server.url)
        yield page
        browser.close()
        server.shutdown()
    desk.close()


def processor_seconds() -> Counter[str]:
    """The processor time that this process and the browser's took so far, by what they do; Linux alone."""
    told, parents = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state = (folder / "stat").read_text().rpartition(")")[2].split()
            command = (folder / "cmdline").read_text()
        except OSError:
            # it has ended
            continue
        kind = next((name for mark, name in KINDS.items() if mark in command), "the rest of the browser")
        number = int(folder.name)
        parents[number] = int(state[1])
        told[number] = "the server" if number == os.getpid() else kind, (int(state[11]) + int(state[12])) / TICKS
    seconds: Counter[str] = Counter()
    for number, (kind, time) in told.items():
        above = number
        while above in parents and above != os.getpid():
            above = parents[above]
        if above == os.getpid():
            seconds[kind] += time
    return seconds
