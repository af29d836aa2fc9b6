"""What a person, or a script, sees while a mission flies."""

from __future__ import annotations

import math
import sys
import time
from enum import StrEnum
from typing import TextIO

from chaserdock_protocol import topics
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from .flight_state import FlightState
from .json_events import Commanded, Line, Progress, Told, line_of

_LIVE_EVERY_S = 0.25
_LINE_EVERY_S = 5.0
_JSON_EVERY_S = 1.0
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
    """To whom a flight is shown: ``people``: a live table on a terminal, else a line now and then, all on standard
    error; ``nobody``; ``scripts``: JSON lines on standard output."""

    people = "people"
    nobody = "nobody"
    scripts = "scripts"


class ProgressReporter:
    """Shows a flight while it is flown."""

    def __init__(self, scenario: Scenario, show: Show, out: TextIO | None = None) -> None:
        self.state = FlightState(scenario)
        self._show = show
        self._out = out if out is not None else sys.stdout
        self._console = Console(stderr=True)
        self._shown_s = time.monotonic()
        self._gone: set[str] = set()
        self._said = ""
        self._live: Live | None = None
        if show is Show.people and self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()

    @property
    def flying(self) -> bool:
        """Whether the first tick has come."""
        return self.state.flying

    @property
    def for_scripts(self) -> bool:
        """Whether standard output belongs to JSON lines."""
        return self._show is Show.scripts

    def subscribe(self, node: Node) -> None:
        """Subscribes what is shown."""
        if self._show is Show.nobody:
            node.subscribe(topics.TICK)
            return
        for topic in _SUBSCRIBED:
            node.subscribe(topic)

    def take(self, message: object) -> None:
        """Notes a message, and tells what it says."""
        for told in self.state.take(message, time.monotonic()):
            self.tell(told)

    def show(self) -> None:
        """Shows how the mission stands, when it is time to; to be called often."""
        now_s = time.monotonic()
        since_s = now_s - self._shown_s
        if self._live is not None and since_s > _LIVE_EVERY_S:
            self._live.update(self._page(now_s), refresh=True)
        elif self._show is Show.scripts and self.flying and since_s > _JSON_EVERY_S:
            self.tell(self.state.progress(now_s))
        elif self._show is Show.people and self._live is None and since_s > _LINE_EVERY_S:
            line = self._line(now_s)
            if line != self._said:  # a start that takes long is told once
                self.say(line)
            self._said = line
        else:
            return
        self._shown_s = now_s

    def tell(self, line: Line) -> None:
        """Tells one thing: as JSON to scripts, in words to people."""
        if self._show is Show.scripts:
            print(line_of(line), file=self._out, flush=True)
        elif isinstance(line, Told | Commanded):
            self.say(words_of(line), _style_of(line))

    def say(self, text: str, style: str = "") -> None:
        """One line to people."""
        if self._show is not Show.people:
            return
        if self._live is not None:
            self._live.console.print(Text(text, style=style))
        else:
            print(text, file=sys.stderr, flush=True)

    def warn(self, process: str, text: str) -> None:
        """Tells once that a process is gone."""
        if process not in self._gone:
            self._gone.add(process)
            time_s = self.state.time_ns / 1e9
            self.tell(
                Told(sim_time_s=time_s, process=process, level="warning", what="has ended", detail=text)
            )

    def close(self) -> None:
        """Tells how the mission stood last, and leaves the terminal as it was."""
        if self._show is Show.scripts and self.flying:
            self.tell(self.state.progress(time.monotonic()))
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
        parts = [f"{self.state.scenario.name}  {head_of(self.state, progress)}"]
        parts += [
            f"{c.chaser} {c.phase} {c.position_error_m * 1e3:.1f} mm {math.degrees(c.orientation_error_rad):.2f} deg"
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
        for column in ("chaser", "phase", "for", "position error", "orientation error", "to the target"):
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
        return Group(bar, Text(head_of(self.state, progress)), table)


def head_of(state: FlightState, progress: Progress) -> str:
    """How far, how fast, how long still, and how well the target is known."""
    text = f"{progress.sim_time_s:6.1f} of {state.scenario.duration_s:g} s  {progress.speed_now:.2f} x real time  "
    left_s = state.left_s(progress)
    if left_s is not None and left_s < 360_000:
        text += f"{int(left_s) // 60}:{int(left_s) % 60:02d} left  "
    return f"{text}target: {progress.target}"


def words_of(line: Told | Commanded) -> str:
    """An event or an answer in words."""
    if isinstance(line, Commanded):
        said = "accepted" if line.accepted else "refused"
        text = f"{line.command} chaser {line.chaser}: {said} ({line.reason})"
    else:
        mark = "" if line.level == "info" else f"{line.level.upper()}: "
        text = f"{mark}{line.process}: {line.what} {line.detail}".rstrip()
    return f"{line.sim_time_s:7.2f} s  {text}"


def _style_of(line: Told | Commanded) -> str:
    if isinstance(line, Told):
        return _STYLES[line.level]
    return "" if line.accepted else "yellow"
