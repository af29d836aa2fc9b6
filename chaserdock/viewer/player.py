# SPDX-License-Identifier: Apache-2.0
"""Viewer of a log: the page with a timeline."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import viser
from chaserdock_protocol.process import StopSignal, print_status
from chaserdock_protocol.recording.scan import LogError, LogSource

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of_run
from chaserdock.exit_codes import STOPPED
from chaserdock.verdict import Verdict, verdict_of

from .address import page_token, url_of
from .logged import LoggedMission
from .page import PERIOD_S, Page, Timeline, ViewOptions
from .report_page import NAME, ReportPage
from .server import page_server


def view_log(
    source: LogSource, options: ViewOptions, at_s: float | None = None, watch_parent: bool = False
) -> int:
    """Serve the page until stopped; return ``STOPPED``. Play from the start, or pause at ``at_s``.

    Raise LogError, or ViewError if the page cannot be served.
    """
    stop, token = StopSignal(watch_parent), page_token()
    mission = LoggedMission(source)
    line = Timeline(mission.end_s)
    if at_s is not None and at_s > mission.end_s:
        raise LogError(f"--at {at_s:g}: the log ends at {mission.end_s:.2f} s")
    if at_s is not None:
        line.at_s, line.playing = at_s, False
    report = ReportPage(source if isinstance(source, Path) else None)
    with page_server(options.host, options.port, token, {NAME: report}) as server:
        print_status(
            "viewer",
            f"{url_of(options.host, server.get_port(), token)} shows the log; Ctrl-C ends this",
        )
        link = None if report.log is None else f"/{token}/{NAME}"
        play(server, source, mission, line, options, link, stop)
    return STOPPED


def play(
    server: viser.ViserServer,
    source: LogSource,
    mission: LoggedMission,
    line: Timeline,
    options: ViewOptions,
    report: str | None,
    stop: Callable[[], bool],
) -> None:
    """Show a log with its verdict and time line until ``stop``. ``report``: path of its report on
    the server.
    """
    judgement = Judgement(source)
    mode = f"log of run {mission.run.get('run_id', '?')}, {mission.run.get('mode', '?')}"
    truth = mission.truth and options.truth
    page = Page(
        server,
        mission.scenario,
        dark=options.dark,
        truth=truth,
        command=None,
        timeline=line,
        report=report,
    )
    before_s = time.monotonic()
    while not stop():
        begun_s = time.monotonic()
        if page.watched:
            advance(line, begun_s - before_s)
            state = mission.at(line.at_s)
            if not truth:
                state.truth.clear()
            page.draw(state, mission.history, mode, None, set(), judgement.verdict)
        before_s = begun_s
        took_s = time.monotonic() - begun_s
        time.sleep(max(PERIOD_S - took_s, 0.2 * took_s))


def show_flown(
    server: viser.ViserServer,
    options: ViewOptions,
    report: ReportPage,
    link: str,
    stop: Callable[[], bool],
) -> None:
    """Show the log in ``options.folder`` of the mission that has just ended, at its end."""
    assert options.folder is not None
    try:
        mission = LoggedMission(options.folder)
    except LogError as error:
        print_status("viewer", str(error))
        server.gui.add_markdown(f"✗ {error}")
        while not stop():
            time.sleep(PERIOD_S)
        return
    report.log = options.folder
    line = Timeline(mission.end_s, mission.end_s, playing=False)
    play(server, options.folder, mission, line, options, link, stop)


class Judgement:
    """The verdict on a log, judged on a thread: the page of a long log does not wait for it.

    ``verdict``: None until then. A log that cannot be judged is a failure that states why.
    """

    def __init__(self, source: LogSource) -> None:
        self.verdict: Verdict | None = None
        self._source = source
        self._thread = threading.Thread(target=self._judge, name="judgement", daemon=True)
        self._thread.start()

    def _judge(self) -> None:
        first = self._source if isinstance(self._source, Path) else self._source[0]
        try:
            self.verdict = verdict_of(summary_of_run(load_flight(self._source), first))
        except LogError as error:
            self.verdict = Verdict(False, not_met=(f"the log cannot be judged: {error}",))

    def wait(self) -> Verdict | None:
        """Wait for the verdict and return it."""
        self._thread.join()
        return self.verdict


def advance(line: Timeline, wall_s: float) -> None:
    """Advance a playing timeline by ``wall_s`` of wall time; it stops at its end."""
    if line.moved:  # the slider has just been moved
        line.moved = False
        return
    if not line.playing:
        return
    if line.at_s >= line.end_s:
        line.playing = False
        return
    line.at_s = min(line.end_s, line.at_s + wall_s * line.speed)
