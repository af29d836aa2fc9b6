# SPDX-License-Identifier: Apache-2.0
"""Leader election between controllers: the world grants numbered terms, one leader at a time. No I/O; time is passed in.

As in Raft (D. Ongaro, J. Ousterhout, 2014) every command carries the number of its term, and commands of an older term
are rejected. A term ends when its leader is lost, or when its lease expires while another controller stands by: the lease
is renewed whenever a chaser executes a command of the term. Term numbers only increase and are never reused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

LEASE_S = 0.18
"""Shortest lease; it covers at least 1.5 ticks (``lease_s``)."""
FIRST_COMMAND_S = 1.0
"""Lease of a new leader until its first command is executed."""
BACKOFF_RESET_S, LEASE_MAX_S = 20.0, 2.0
"""A lease that expires again within ``BACKOFF_RESET_S`` doubles, up to ``LEASE_MAX_S``: repeated expiry means that the
machine is overloaded, and a change of leader does not help."""


@dataclass(frozen=True)
class Term:
    """One term of office: the leader's process name and the instance (start) of that process; both empty without one."""

    number: int = 0
    commander: str = ""
    instance: str = ""

    def is_led_by_one_of(self, instances: Mapping[str, str]) -> bool:
        """Return whether the leader is among ``instances`` (process name to instance)."""
        return bool(self.commander) and instances.get(self.commander) == self.instance


def next_term(term: Term, instances: Mapping[str, str], silent: frozenset[str]) -> Term:
    """Return the term that follows, ``term`` itself if its leader stays.

    ``instances``: connected controllers (name to instance) in order of priority. Instances in ``silent`` are not elected,
    and stay leader only if no other controller is eligible.
    """
    eligible = {name: instance for name, instance in instances.items() if instance not in silent}
    if term.is_led_by_one_of(eligible) or (not eligible and term.is_led_by_one_of(instances)):
        return term
    for name, instance in (eligible or instances).items():
        return Term(term.number + 1, name, instance)
    return replace(term, commander="", instance="")


def lease_s(rate_hz: float) -> float:
    """Return the length of a lease at this tick rate."""
    return max(LEASE_S, 1.5 / rate_hz)


@dataclass
class LeaderElection:
    """The current term and its lease. Times: wall clock in real time, simulated time in lock-step."""

    lease_s: float
    term: Term = field(default_factory=Term)
    _elected_s: float = 0.0
    _renewed_s: float | None = None
    _backoff_lease_s: float = 0.0
    _expired_s: float | None = None
    _silent: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._backoff_lease_s = self.lease_s

    def renew_lease(self, term_number: int, now_s: float) -> None:
        """Renew the lease: a chaser has executed a command of this term. Other terms than the current are ignored."""
        if term_number == self.term.number:
            self._renewed_s = now_s

    def mark_responsive(self, instance: str) -> None:
        """Make a controller eligible again whose lease had expired: it publishes its presence."""
        self._silent.discard(instance)

    def expired_for_s(self, now_s: float) -> float:
        """Return how long the leader has been silent if its lease has expired, else 0."""
        since_s = self._renewed_s
        allowed_s = self._backoff_lease_s if self._in_backoff(now_s) else self.lease_s
        if since_s is None:
            since_s, allowed_s = self._elected_s, max(FIRST_COMMAND_S, allowed_s)
        silent_s = now_s - since_s
        return silent_s if self.term.commander and silent_s > allowed_s + 1e-6 else 0.0

    def _in_backoff(self, now_s: float) -> bool:
        return self._expired_s is not None and now_s - self._expired_s < BACKOFF_RESET_S

    def update(self, instances: Mapping[str, str], now_s: float) -> str:
        """Grant a new term if one is due; return the reason as text for the log, empty without a change.

        ``instances``: connected controllers (name to instance) in order of priority.
        """
        before, silent_s = self.term, self.expired_for_s(now_s)
        silent = self._silent & set(instances.values())
        if silent_s and before.is_led_by_one_of(instances):
            silent = silent | {before.instance}
        after = next_term(before, instances, frozenset(silent))
        if after == before:
            return ""
        if before.is_led_by_one_of(instances):
            self._silent = silent
            doubled_s = max(self.lease_s, min(2.0 * self._backoff_lease_s, LEASE_MAX_S))
            self._backoff_lease_s = doubled_s if self._in_backoff(now_s) else self.lease_s
            self._expired_s = now_s
            reason = f"no command of {before.commander} executed for {silent_s:.2f} s"
        else:
            reason = f"{before.commander} lost" if before.commander else "no leader before"
        self.term, self._elected_s, self._renewed_s = after, now_s, None
        if not after.commander:
            return f"no leader: {reason}"
        return f"term {after.number}: {after.commander} leads: {reason}"
