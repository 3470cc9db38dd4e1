"""The viewer's page in headless Chromium, drawn without a graphics card."""

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Page, sync_playwright

from stereokit.viewer import Desk, ViewServer

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@contextmanager
def viewer_page(desk: Desk, *, width: int, height: int) -> Iterator[Page]:
    """A page that looks at a desk; closes both in the end."""
    with ViewServer(desk, port=0) as server, sync_playwright() as api:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = api.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(120_000)
        page.goto(server.url)
        yield page
        browser.close()
        server.shutdown()
    desk.close()
