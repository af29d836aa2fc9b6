# SPDX-License-Identifier: Apache-2.0
"""Photograph the viewer: ``python docs/make_viewer_images.py [FOLDER]`` (default: docs/images).

Needs chromium and the packages of requirements-dev.txt. Shows ``--log RUN``, or a flight of
``two-chaser-tracking`` that is flown into runs/images/docs-viewer unless its log is there.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from browser import PATIENCE_MS, chromium  # noqa: E402

FLIGHT = ("two-chaser-tracking", "--set", "duration_s=30", "--set", "success={}")
"""The flight that is shown, as arguments of ``chaserdock run``."""
AT_S = 12.0
"""Time (s) of the pictures: the paths to the nominal places are still drawn."""
SETTLED_MS = 10_000.0
"""Time (ms) that a browser without a GPU may take to draw images and labels of one moment. Larger:
slower; smaller: pictures of two moments.
"""


@dataclass(frozen=True)
class Shot:
    """A picture of the page: size of the window (px) and colours."""

    width_px: int
    height_px: int
    dark: bool = False


SHOTS = {
    "viewer-log": Shot(1280, 800),
    "viewer-dark": Shot(1280, 800, dark=True),
    "viewer-phone": Shot(390, 844),
}


@contextmanager
def viewer(log: Path, at_s: float) -> Iterator[str]:
    """Serve the page of a log on a free port; yield its address."""
    command = [sys.executable, "-m", "chaserdock", "view", str(log), "--at", f"{at_s:g}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        said = process.stderr.readline()
        found = re.search(r"http://\S+", said)
        if found is None:
            sys.exit(f"make_viewer_images: {said.strip()}")
        yield found[0]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()
        if process.stderr is not None:
            process.stderr.close()


def photograph(browser: Any, url: str, shot: Shot) -> np.ndarray:
    """Return the page in colour (BGR), once it shows the verdict and all panels."""
    page = browser.new_page(viewport={"width": shot.width_px, "height": shot.height_px})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(url + ("?darkMode" if shot.dark else ""))
    page.locator("text=/verdict: /").first.wait_for()
    # Without a GPU viser warns over the scene.
    for close in page.locator(".mantine-Notification-closeButton").all():
        close.click()
    if shot.width_px > 600:
        page.locator("text=position error, mm").first.wait_for()
    page.wait_for_timeout(SETTLED_MS)
    data = page.screenshot(type="png", timeout=PATIENCE_MS)
    page.close()
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))


def flown() -> Path:
    """Return the run of ``FLIGHT``, flown unless it is there."""
    out = ROOT / "runs" / "images" / "docs-viewer"
    if not (out / "summary.json").exists():
        command = [sys.executable, "-m", "chaserdock", "run", *FLIGHT, "--out", str(out)]
        subprocess.run(command, check=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument("--log", type=Path, metavar="RUN", help="show this log instead")
    parser.add_argument("--at", type=float, default=AT_S, metavar="S", help="at this time")
    options = parser.parse_args()
    log = options.log or flown()
    with viewer(log, options.at) as url, chromium() as browser:
        for name, shot in SHOTS.items():
            path = options.folder / f"{name}.webp"
            image = photograph(browser, url, shot)
            cv2.imwrite(str(path), image, [cv2.IMWRITE_WEBP_QUALITY, 80])
            print(f"{path}  {path.stat().st_size} bytes", flush=True)


if __name__ == "__main__":
    main()
