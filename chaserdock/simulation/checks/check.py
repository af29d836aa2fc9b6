# SPDX-License-Identifier: Apache-2.0
"""Base class of the checks of a simulated flight: texts, state, and what a check finds."""

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

    ``name``: name of its violations. ``exceptions``: when it is not judged. ``view``: the flight so
    far, including the present message. Names of the module's constants in double backquotes stand
    for their values in docs/invariants.md.
    """

    name: ClassVar[str]
    exceptions: ClassVar[tuple[str, ...]] = ()

    view: FlightView
    report: Callable[[str, str, str], None]

    def __post_init__(self) -> None:
        self.scenario = self.view.scenario
        self.begin()

    def begin(self) -> None:
        """Derive state that does not change during the flight."""

    def violate(self, subject: str, text: str) -> None:
        """Report that the invariant does not hold for a subject: a body, a process or a key."""
        self.report(self.name, subject, text)

    def end(self, flight: SimulatedFlight) -> None:
        """Judge what must hold when the flight is over."""
