"""A viewer that runs beside a program, and its page in a Chromium that is installed."""

import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from featuredb.store import Database
from reloc.viewer.photos import Pictures
from reloc.viewer.query import Queries
from reloc.viewer.scene import ViewerScene
from reloc.viewer.server import HOST, create_app, listen, uvicorn_server

_SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def open_page(database: Database, scene: ViewerScene, photos: Path | None) -> Iterator[Page]:
    """The page of a scene, 1280 x 720, loaded."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("there is no Chromium: apt-get install chromium")
    options = [*_SOFTWARE_GL, *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    server = uvicorn_server(create_app(scene, Pictures(photos), Queries(database, scene)))
    with listen(0) as bound, sync_playwright() as playwright:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
        thread.start()
        browser = playwright.chromium.launch(executable_path=chromium, args=options)
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.goto(f"http://{HOST}:{bound.getsockname()[1]}/")
            page.evaluate("window.featuredb.then(() => true)")
            yield page
        finally:
            browser.close()
            server.should_exit = True
            thread.join(30.0)


def settled(page: Page) -> None:
    """Wait until the page has drawn all points of a view that has come to rest."""
    time.sleep(0.5)
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
