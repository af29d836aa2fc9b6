"""Which controller commands: one at any time, by numbered terms that the world alone grants. No I/O; time is given.

A term ends when its commander is gone, or when no chaser has flown a command of it for a lease while another controller
stands by. The number never falls and is never given twice: whoever holds an older one is out of date, and refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

LEASE_S = 0.18
"""A commander none of whose commands is flown for so long, and 1.5 ticks at least, loses the command."""
BEGIN_S = 1.0
"""So long it has for its first."""
CALM_S, LONGEST_S = 20.0, 2.0
"""Commanders that are lost for silence again within ``CALM_S`` double the lease, up to ``LONGEST_S``: it is then the
machine that is slow, and another commander no faster."""


@dataclass(frozen=True)
class Term:
    """``commander``, in its start ``instance``, commands; nobody does where both are empty."""

    number: int = 0
    commander: str = ""
    instance: str = ""

    def is_held_by(self, here: Mapping[str, str]) -> bool:
        """Whether its commander is among those ``here`` (name to instance)."""
        return bool(self.commander) and here.get(self.commander) == self.instance


def following(term: Term, here: Mapping[str, str], silent: frozenset[str]) -> Term:
    """The term that follows from who is ``here`` (name to instance, in the order of succession); ``silent`` instances
    do not get the command, and keep it only where nobody else can have it."""
    able = {name: instance for name, instance in here.items() if instance not in silent}
    if term.is_held_by(able) or (not able and term.is_held_by(here)):
        return term
    for name, instance in (able or here).items():
        return Term(term.number + 1, name, instance)
    return replace(term, commander="", instance="")


def lease_s(rate_hz: float) -> float:
    """How long a commander may be silent at that many ticks a second."""
    return max(LEASE_S, 1.5 / rate_hz)


@dataclass
class Terms:
    """The present term, and when a command of it was flown last. Times are wall time in real time, else simulated."""

    lease_s: float
    term: Term = field(default_factory=Term)
    _since_s: float = 0.0
    _heard_s: float | None = None
    _allowed_s: float = 0.0
    _silenced_s: float | None = None
    _silent: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._allowed_s = self.lease_s

    def flown(self, number: int, now_s: float) -> None:
        """A chaser has flown a command of term ``number``."""
        if number == self.term.number:
            self._heard_s = now_s

    def lives(self, instance: str) -> None:
        """A controller that was silent tells its presence: it can be given the command again."""
        self._silent.discard(instance)

    def silence_s(self, now_s: float) -> float:
        """How long the commander has been silent beyond what it may; 0 when it is not."""
        since_s, allowed_s = self._heard_s, self._allowed_s if self._is_restless(now_s) else self.lease_s
        if since_s is None:
            since_s, allowed_s = self._since_s, max(BEGIN_S, allowed_s)
        silent_s = now_s - since_s
        return silent_s if self.term.commander and silent_s > allowed_s + 1e-6 else 0.0

    def _is_restless(self, now_s: float) -> bool:
        return self._silenced_s is not None and now_s - self._silenced_s < CALM_S

    def review(self, here: Mapping[str, str], now_s: float) -> str:
        """Grants a new term where one is due; why, in words for the log, empty when all stays as it is."""
        before, silent_s = self.term, self.silence_s(now_s)
        silent = self._silent & set(here.values())
        if silent_s and before.is_held_by(here):
            silent = silent | {before.instance}
        after = following(before, here, frozenset(silent))
        if after == before:
            return ""
        if before.is_held_by(here):
            self._silent = silent
            again = self._silenced_s is not None and now_s - self._silenced_s < CALM_S
            self._allowed_s = (
                max(self.lease_s, min(2.0 * self._allowed_s, LONGEST_S)) if again else self.lease_s
            )
            self._silenced_s = now_s
            why = f"{before.commander} has been silent for {silent_s:.2f} s"
        else:
            why = f"{before.commander} is gone" if before.commander else "nobody did"
        self.term, self._since_s, self._heard_s = after, now_s, None
        if not after.commander:
            return f"nobody commands: {why}"
        return f"term {after.number}: {after.commander} commands: {why}"
