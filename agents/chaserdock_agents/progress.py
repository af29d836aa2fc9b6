"""What a person sees while a mission flies."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field

import numpy as np
from chaserdock_protocol import rotations, topics
from chaserdock_protocol.messages import CommandReply, Event, Odometry, Reference, TargetEstimate, Tick
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

_LINE_EVERY_S = 5.0


@dataclass
class Progress:
    """A live table on a terminal, a line now and then elsewhere, nothing when quiet."""

    scenario: Scenario
    mode: str
    quiet: bool
    flying: bool = False
    _odometry: dict[tuple[int, int], Odometry] = field(default_factory=dict)
    _reference: dict[int, Reference] = field(default_factory=dict)
    _target: TargetEstimate | None = None
    _time_ns: int = 0
    _begun_s: float = 0.0
    _shown_s: float = 0.0
    _warned: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._console = Console(stderr=True)
        self._live: Live | None = None
        if not self.quiet and self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()

    def subscribe(self, node: Node) -> None:
        """Subscribes what is shown."""
        for topic in (
            topics.TICK,
            topics.ODOMETRY,
            topics.REFERENCE,
            topics.TARGET,
            topics.EVENT,
            topics.COMMAND,
        ):
            node.subscribe(topic)

    def take(self, message: object) -> None:
        """Notes a message; shows the state at intervals."""
        match message:
            case Tick():
                if not self.flying:
                    self.flying, self._begun_s = True, time.monotonic()
                self._time_ns = message.sim_time_ns
            case Odometry():
                self._odometry[message.chaser, message.tick] = message
                self._odometry.pop((message.chaser, message.tick - 50), None)
            case Reference():
                self._reference[message.chaser] = message
            case TargetEstimate():
                self._target = message
            case Event():
                self.say(
                    f"{message.sim_time_ns / 1e9:7.2f} s  {message.process}: {message.what} {message.detail}"
                )
            case CommandReply():
                said = "accepted" if message.accepted else "refused"
                text = f"{message.command} chaser {message.chaser}: {said} ({message.reason})"
                self.say(f"{message.sim_time_ns / 1e9:7.2f} s  {text}")
        now_s = time.monotonic()
        if self._live is not None and now_s - self._shown_s > 0.25:
            self._shown_s = now_s
            self._live.update(self._table(), refresh=True)
        elif self._live is None and now_s - self._shown_s > _LINE_EVERY_S and self.flying:
            self._shown_s = now_s
            self.say(self._line())

    def errors(self, chaser: int) -> tuple[float, float] | None:
        """Position (m) and orientation (rad) error of a chaser from its reference, as the controller sees it."""
        there = self._reference.get(chaser)
        here = self._odometry.get((chaser, there.tick)) if there is not None else None
        if here is None or there is None:
            return None
        position = float(np.linalg.norm(np.subtract(here.position_m, there.position_m)))
        return position, float(rotations.angle_between(there.q_wxyz, here.q_wxyz))

    def _head(self) -> str:
        wall_s = max(1e-9, time.monotonic() - self._begun_s)
        factor = self._time_ns / 1e9 / wall_s
        status = self._target.status if self._target is not None else "none"
        return (
            f"{self.scenario.name}  {self._time_ns / 1e9:6.1f} of {self.scenario.duration_s:g} s  "
            f"{factor:.2f} x real time  target: {status}"
        )

    def _line(self) -> str:
        parts = [self._head()]
        for i in range(len(self.scenario.chasers)):
            errors = self.errors(i)
            if errors is not None:
                phase = self._reference[i].phase
                parts.append(f"{i} {phase} {errors[0] * 1e3:.1f} mm {math.degrees(errors[1]):.2f} deg")
        return " | ".join(parts)

    def _table(self) -> Table:
        table = Table(title=self._head() if self.flying else f"{self.scenario.name}: starting")
        for column in ("chaser", "phase", "position error", "orientation error", "to the target"):
            table.add_column(column, justify="right")
        for i in range(len(self.scenario.chasers)):
            errors, reference = self.errors(i), self._reference.get(i)
            if errors is None or reference is None:
                table.add_row(str(i), "-", "-", "-", "-")
                continue
            distance = math.hypot(*reference.offset_m)
            table.add_row(
                str(i),
                reference.phase,
                f"{errors[0] * 1e3:.2f} mm",
                f"{math.degrees(errors[1]):.3f} deg",
                f"{distance:.3f} m",
            )
        return table

    def say(self, text: str) -> None:
        """One line, unless quiet."""
        if self.quiet:
            return
        if self._live is not None:
            self._live.console.print(Text(text))
        else:
            print(text, file=sys.stderr, flush=True)

    def warn(self, process: str, text: str) -> None:
        """Tells once that a process is gone."""
        if process not in self._warned:
            self._warned.add(process)
            self.say(f"{process} has ended: {text}")

    def close(self) -> None:
        """Leaves the terminal as it was."""
        if self._live is not None:
            self._live.stop()
            self._live = None
