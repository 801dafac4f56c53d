"""A headless browser for tests of pages: Debian's chromium with WebGL2 by SwiftShader, driven by playwright."""

from __future__ import annotations

import contextlib
import pathlib
import shutil

import pytest

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"]


@contextlib.contextmanager
def open_browser(flags=()):
    """A running chromium; skips the test without one, and says so."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found:
        pytest.skip("no chromium here: apt-get install chromium")
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright here: pip install playwright")
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=[*FLAGS, *flags])
        try:
            yield browser
        finally:
            browser.close()


class Tab:
    """A page opened from a file, with its console errors and the addresses that it asked for."""

    def __init__(self, browser, path, size=(960, 700), script="", **options):
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]}, **options)
        self.page.add_init_script(script)
        self.errors, self.requests = [], []
        self.page.on("console", lambda told: self.errors.append(told.text) if told.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda asked: self.requests.append(asked.url))
        self.address = pathlib.Path(path).resolve().as_uri()
        self.page.goto(self.address)
        self.page.wait_for_function("window.page")

    def __call__(self, script, *values):
        """The value of an expression, or of a function of the values, in the page."""
        return self.page.evaluate(script, *values)

    @property
    def foreign(self):
        """Addresses asked for beside the page itself; its icon is empty data."""
        return [url for url in self.requests if url != self.address and not url.startswith("data:")]
