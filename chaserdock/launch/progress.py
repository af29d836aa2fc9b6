# SPDX-License-Identifier: Apache-2.0
"""Show the progress of a mission: a live table, text lines, or JSON lines."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from enum import StrEnum

from chaserdock_protocol import topics
from chaserdock_protocol.messages import Message
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from .flight_state import FlightState
from .json_events import CommandNotice, EventNotice, JsonLine, Progress, Start, encode_line

_LIVE_EVERY_S = 0.25
"""Time (s) between two updates of the table on a terminal: figures can still be read."""
_LINE_EVERY_S = 5.0
"""Time (s) between two lines where output is not a terminal. Smaller: longer logs."""
_JSON_EVERY_S = 1.0
"""Time (s) between two JSON lines of progress. Larger: programs see progress later; smaller: more
lines.
"""
_STYLES = {"info": "", "warning": "yellow", "error": "bold red"}
_SUBSCRIBED = (
    topics.TICK,
    topics.ODOMETRY,
    topics.REFERENCE,
    topics.TARGET,
    topics.SOLVER,
    topics.EVENT,
    topics.COMMAND,
    topics.HEALTH,
    topics.PRESENCE,
)


class Show(StrEnum):
    """How progress is shown.

    ``text``: on standard error, as a live table on a terminal, otherwise a line every few seconds.
    ``none``: not at all. ``json``: JSON lines, on standard output by default.
    """

    text = "text"
    none = "none"
    json = "json"


def print_json_line(line: JsonLine) -> None:
    """Print a JSON line on standard output."""
    print(encode_line(line), flush=True)


class ProgressReporter:
    """Shows the progress of a mission. With ``Show.json`` every line goes to ``emit``."""

    def __init__(
        self, scenario: Scenario, show: Show, emit: Callable[[JsonLine], None] = print_json_line
    ) -> None:
        self.state = FlightState(scenario)
        self.show = show
        self._emit = emit
        self._console = Console(stderr=True)
        self._shown_s = -math.inf  # the first refresh shows what the mission waits for
        self._lost: set[str] = set()
        self._last_line = ""
        self._live: Live | None = None
        if show is Show.text and self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()

    @property
    def flying(self) -> bool:
        """Whether the first tick has arrived."""
        return self.state.flying

    def subscribe(self, node: Node) -> None:
        """Subscribe to the topics that are shown."""
        for topic in _SUBSCRIBED if self.show is not Show.none else (topics.TICK,):
            node.subscribe(topic)

    def update(self, message: object) -> None:
        """Apply a message and report its notices."""
        for notice in self.state.update(message, time.monotonic()):
            self.report(notice)

    def refresh(self) -> None:
        """Show the progress when it is due; call this often."""
        now_s = time.monotonic()
        since_s = now_s - self._shown_s
        if self._live is not None and since_s > _LIVE_EVERY_S:
            self._live.update(self._page(now_s), refresh=True)
        elif self.show is Show.json and self.flying and since_s > _JSON_EVERY_S:
            self._emit(self.state.progress(now_s))
        elif self.show is Show.text and self._live is None and since_s > _LINE_EVERY_S:
            line = self._line(now_s)
            if line != self._last_line:  # unchanged during a slow start
                self.print_text(line)
            self._last_line = line
        else:
            return
        self._shown_s = now_s

    def report(self, line: JsonLine) -> None:
        """Report one line: as JSON, or notices as text."""
        if self.show is Show.json:
            self._emit(line)
        elif isinstance(line, Start):
            self.print_text(f"{line.scenario}: {line.folder}; join with {line.address.options()}")
        elif isinstance(line, EventNotice | CommandNotice):
            self.print_text(text_of(line), _style_of(line))

    def print_text(self, text: str, style: str = "") -> None:
        """Print one line of text, with ``Show.text`` only."""
        if self.show is not Show.text:
            return
        if self._live is not None:
            self._live.console.print(Text(text, style=style))
        else:
            print(text, file=sys.stderr, flush=True)

    def report_lost(self, process: str, text: str) -> None:
        """Report, once, that a process has exited."""
        if process not in self._lost:
            self._lost.add(process)
            time_s = self.state.time_ns / 1e9
            self.report(
                EventNotice(
                    sim_time_s=time_s,
                    process=process,
                    level="warning",
                    what="has exited",
                    detail=text,
                )
            )

    def report_foreign(self, detail: str, newest: Message | None) -> None:
        """Report a session that publishes on the world's keys (`ignore_foreign_publishers`)."""
        time_s = self.state.time_ns / 1e9
        self.report(
            EventNotice(
                sim_time_s=time_s,
                process="operator",
                level="warning",
                what="foreign publisher",
                detail=detail,
            )
        )

    def close(self) -> None:
        """Show the last progress and restore the terminal."""
        if self.show is Show.json and self.flying:
            self._emit(self.state.progress(time.monotonic()))
        if self._live is not None:
            self._live.update(self._page(time.monotonic()), refresh=True)
            self._live.stop()
            self._live = None

    def _starting(self) -> str:
        waiting = self.state.waiting_for()
        text = f"{self.state.scenario.name}: starting"
        return f"{text}, waiting for {', '.join(waiting)}" if waiting else text

    def _line(self, now_s: float) -> str:
        if not self.flying:
            return self._starting()
        progress = self.state.progress(now_s)
        parts = [f"{self.state.scenario.name}  {headline(self.state, progress)}"]
        parts += [
            f"{c.chaser} {c.phase} {c.position_error_m * 1e3:.1f} mm "
            f"{math.degrees(c.orientation_error_rad):.2f} deg"
            for c in progress.chasers
        ]
        return " | ".join(parts)

    def _page(self, now_s: float) -> Group | Text:
        if not self.flying:
            return Text(self._starting())
        progress, scenario = self.state.progress(now_s), self.state.scenario
        bar = Table.grid(padding=(0, 1))
        bar.add_row(
            Text(scenario.name, style="bold"),
            ProgressBar(total=scenario.duration_s, completed=progress.sim_time_s, width=30),
        )
        table = Table()
        for column in (
            "chaser",
            "phase",
            "phase time",
            "position error",
            "orientation error",
            "target distance",
        ):
            table.add_column(column, justify="right")
        for c in progress.chasers:
            table.add_row(
                str(c.chaser),
                c.phase,
                f"{c.phase_time_s:.0f} s",
                f"{c.position_error_m * 1e3:.2f} mm",
                f"{math.degrees(c.orientation_error_rad):.3f} deg",
                f"{c.reference_distance_m:.3f} m",
            )
        return Group(bar, Text(headline(self.state, progress)), table)


def headline(state: FlightState, progress: Progress) -> str:
    """Return simulated time, speed, remaining wall time and the status of the target estimate as
    text.
    """
    text = f"{progress.sim_time_s:6.1f} of {state.scenario.duration_s:g} s  "
    text += f"{progress.speed_now:.2f} x real time  "
    remaining_s = state.remaining_s(progress)
    if remaining_s is not None and remaining_s < 360_000:
        text += f"{int(remaining_s) // 60}:{int(remaining_s) % 60:02d} left  "
    return f"{text}target: {progress.target}"


def text_of(line: EventNotice | CommandNotice) -> str:
    """Return a notice as text."""
    if isinstance(line, CommandNotice):
        verdict = "accepted" if line.accepted else "refused"
        text = f"{line.command} chaser {line.chaser}: {verdict} ({line.reason})"
    else:
        prefix = "" if line.level == "info" else f"{line.level.upper()}: "
        text = f"{prefix}{line.process}: {line.what} {line.detail}".rstrip()
    return f"{line.sim_time_s:7.2f} s  {text}"


def _style_of(line: EventNotice | CommandNotice) -> str:
    if isinstance(line, EventNotice):
        return _STYLES[line.level]
    return "" if line.accepted else "yellow"
