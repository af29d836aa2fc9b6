# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium for tests of the viewer's page, driven by Playwright, without a GPU."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import psutil
from playwright.sync_api import Browser, Page, sync_playwright

PATIENCE_MS = 600_000.0
"""Generous: rendering without a GPU is slow, and no test measures it."""
_NO_GPU = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


def why_no_browser() -> str:
    """Return the reason why no browser is available, or an empty string."""
    return "" if chromium_path() else "chromium is not installed (Debian: apt-get install chromium)"


def chromium_path() -> str | None:
    return (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )


@contextmanager
def chromium() -> Iterator[Browser]:
    """Run a browser and end it in any case, even if frozen."""
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


def open_page(
    browser: Browser, url: str, width_px: int = 1000, height_px: int = 600, script: str = ""
) -> Page:
    """Open a tab on ``url`` at low resolution, which reduces the load. ``script``: run before those
    of the page.
    """
    page = browser.new_page(viewport={"width": width_px, "height": height_px})
    page.add_init_script(script)
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}/?fixedDpr=0.3")
    return page


def freeze(browser_of: psutil.Process) -> list[psutil.Process]:
    """Stop (SIGSTOP) every browser process that ``browser_of`` has started; return them."""
    chromes = [p for p in browser_of.children(recursive=True) if "chrom" in p.name()]
    for process in chromes:
        process.suspend()
    return chromes
