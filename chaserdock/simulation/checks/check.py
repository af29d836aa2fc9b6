# SPDX-License-Identifier: Apache-2.0
"""What every check of a simulated flight has: its text, its state, and the messages it reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

if TYPE_CHECKING:
    from ..mission import SimulatedFlight
    from .flight_view import FlightView

Method = TypeVar("Method", bound=Callable[..., None])


@dataclass(frozen=True)
class Violation:
    """An invariant that did not hold: its name, the mission time (s), and what was found."""

    invariant: str
    time_s: float
    text: str

    def __str__(self) -> str:
        return f"{self.invariant} at {self.time_s:.2f} s: {self.text}"


def reads(kind: type) -> Callable[[Method], Method]:
    """Mark the method of a ``Reader`` that is called with each message of a type."""

    def mark(method: Method) -> Method:
        method.__dict__["_reads"] = kind
        return method

    return mark


class Reader:
    """Reads messages of some types as they are published, by methods marked with ``reads``."""

    def readers(self) -> Iterator[tuple[type, Callable[[Any], None]]]:
        """Yield each type of message that is read, and the method to call with one."""
        for name, method in vars(type(self)).items():
            if kind := getattr(method, "_reads", None):
                yield kind, getattr(self, name)


@dataclass
class Check(Reader):
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
