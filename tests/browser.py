"""A headless Chromium for tests of the viewer's page: Debian's, driven by Playwright, drawing without a GPU."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import psutil
from playwright.sync_api import Browser, Page, sync_playwright

PATIENCE_MS = 600_000.0
"""A busy machine without a GPU takes its time; nothing here is judged by how long it took."""
_NO_GPU = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def why_no_browser() -> str:
    """Why pages cannot be tried here, or nothing."""
    return "" if chromium_path() else "no chromium here (Debian: apt-get install chromium)"


def chromium_path() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser of its own, ended in any case, frozen or not."""
    with sync_playwright() as playwright:
        before = set(psutil.Process().children(recursive=True))
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=list(_NO_GPU))
        try:
            yield browser
        finally:
            for process in set(psutil.Process().children(recursive=True)) - before:
                if process.is_running() and process.status() == psutil.STATUS_STOPPED:
                    process.resume()
            browser.close()


def open_page(browser: Browser, url: str, width_px: int = 1000, height_px: int = 600) -> Page:
    """A tab on ``url``, drawing coarsely to spare the processor."""
    page = browser.new_page(viewport={"width": width_px, "height": height_px})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}/?fixedDpr=0.3")
    return page


def freeze(browser_of: psutil.Process) -> list[psutil.Process]:
    """Stops (SIGSTOP) every process of the browsers that ``browser_of`` has started; which they are."""
    chromes = [p for p in browser_of.children(recursive=True) if "chrom" in p.name()]
    for process in chromes:
        process.suspend()
    return chromes
