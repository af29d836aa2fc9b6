# SPDX-License-Identifier: Apache-2.0
"""What every check of a simulated flight has: its texts, its state, and what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from ..mission import SimulatedFlight
from .flight_view import FlightView
from .reader import MessageReader


@dataclass(frozen=True)
class Violation:
    """An invariant that did not hold: its name, the mission time (s), and what was found."""

    invariant: str
    time_s: float
    text: str

    def __str__(self) -> str:
        return f"{self.invariant} at {self.time_s:.2f} s: {self.text}"


@dataclass
class Check(MessageReader):
    """An invariant of a flight. Its docstring states what holds, in one sentence.

    ``name``: what violations are called. ``exceptions``: when it is not judged. ``view``: the
    flight so far, the message that is being read included. Names of constants of the module in
    double backquotes stand for their values in docs/invariants.md.
    """

    name: ClassVar[str]
    exceptions: ClassVar[tuple[str, ...]] = ()

    view: FlightView
    report: Callable[[str, str, str], None]

    def __post_init__(self) -> None:
        self.scenario = self.view.scenario
        self.begin()

    def begin(self) -> None:
        """Derive what does not change during the flight."""

    def violate(self, subject: str, text: str) -> None:
        """Report that the invariant does not hold for a subject: a body, a process, a key."""
        self.report(self.name, subject, text)

    def end(self, flight: SimulatedFlight) -> None:
        """Judge what must hold when the flight is over."""
