"""The viewer on a log: the same page with a time line."""

from __future__ import annotations

import time

from chaserdock_protocol.process import StopSignal, print_status
from chaserdock_protocol.recording.scan import LogError, LogSource

from .address import url_of
from .live import PERIOD_S, ViewOptions
from .logged import LoggedMission
from .page import Page, TimeLine
from .server import page_server


def view_log(
    source: LogSource, options: ViewOptions, at_s: float | None = None, watch_parent: bool = False
) -> int:
    """Serves the page on a log until stopped; 0. It plays from the start, or stands still at ``at_s``.

    Raises LogError, or ViewError when the page cannot be served."""
    stop = StopSignal(watch_parent)
    mission = LoggedMission(source)
    line = TimeLine(mission.end_s)
    if at_s is not None and at_s > mission.end_s:
        raise LogError(f"--at {at_s:g}: the log ends at {mission.end_s:.2f} s")
    if at_s is not None:
        line.at_s, line.playing = at_s, False
    mode = f"log of run {mission.run.get('run_id', '?')}, {mission.run.get('mode', '?')}"
    with page_server(options.host, options.port) as server:
        truth = mission.truth and options.truth
        page = Page(server, mission.scenario, dark=options.dark, truth=truth, command=None, timeline=line)
        print_status("viewer", f"{url_of(options.host, server.get_port())} shows the log; Ctrl-C ends this")
        before_s = time.monotonic()
        while not stop():
            begun_s = time.monotonic()
            if page.watched:
                advance(line, begun_s - before_s)
                now = mission.at(line.at_s)
                if not truth:
                    now.truth.clear()
                page.draw(now, mission.history, mode, None, set())
            before_s = begun_s
            took_s = time.monotonic() - begun_s
            time.sleep(max(PERIOD_S - took_s, 0.2 * took_s))
    return 0


def advance(line: TimeLine, wall_s: float) -> None:
    """Moves a playing time line on by so much wall time; it stops at its end, and plays from the start after that."""
    if line.moved:  # a person has just put it somewhere
        line.moved = False
        return
    if not line.playing:
        return
    if line.at_s >= line.end_s:
        line.playing = False
        return
    line.at_s = min(line.end_s, line.at_s + wall_s * line.speed)
