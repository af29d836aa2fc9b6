# SPDX-License-Identifier: Apache-2.0
"""The report of a log on the viewer's server, made when it is first asked for."""

from __future__ import annotations

import threading
from html import escape
from http import HTTPStatus
from pathlib import Path

from chaserdock_protocol.errors import ChaserdockError

from chaserdock.analysis.report import report_of

NAME = "report.html"
"""Name of the page, below the token."""
_WAIT = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="1">'
    '<meta name="viewport" content="width=device-width"><title>report</title>'
    "<p>The report is being made.</p></html>"
)


class ReportPage:
    """Makes the report of ``log`` on a thread; until it is ready, a page that asks again."""

    def __init__(self, log: Path | None = None) -> None:
        self.log = log
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._made: tuple[HTTPStatus, str] | None = None

    def __call__(self, query: str = "") -> tuple[HTTPStatus, str]:
        """Return status and HTML. Does not wait: the caller serves the page's web socket, too."""
        if self.log is None:
            return HTTPStatus.NOT_FOUND, "<p>There is no log yet.</p>"
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._make, args=(self.log,), name="report", daemon=True
                )
                self._thread.start()
            return self._made or (HTTPStatus.OK, _WAIT)

    def wait(self) -> None:
        """Wait for a report that is being made."""
        if self._thread is not None:
            self._thread.join()

    def _make(self, log: Path) -> None:
        try:
            made = HTTPStatus.OK, report_of(log)
        except ChaserdockError as error:
            made = HTTPStatus.INTERNAL_SERVER_ERROR, f"<p>{escape(str(error))}</p>"
        with self._lock:
            self._made = made
