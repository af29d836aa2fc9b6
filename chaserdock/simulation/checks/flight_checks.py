# SPDX-License-Identifier: Apache-2.0
"""All checks of one flight: each message is read once, by what needs it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any, TypeVar

from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import WorldTruth
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import RawSample

from ..mission import SimulatedFlight
from ..network import decode_once
from . import bodies, commands, docking, estimates, messages, processes, thrusters, tracking
from .check import Check, Violation
from .flight_view import FlightView

CHECKS: tuple[type[Check], ...] = (
    messages.ValidMessages,
    bodies.NoContact,
    bodies.KeepOutZone,
    bodies.InitialState,
    bodies.Displacement,
    bodies.LinearMomentum,
    bodies.AngularMomentum,
    bodies.OnFloor,
    bodies.TargetMotion,
    bodies.TumbleFalls,
    commands.NoStaleCommand,
    commands.NoSupersededCommand,
    commands.OneCommander,
    commands.NoHandOverWithoutCause,
    commands.CommandsAreFlown,
    commands.ThrustersOpen,
    commands.PlanIsFlown,
    thrusters.NoHealthyThrusterSuspected,
    thrusters.ThrustersAsExpected,
    estimates.AccurateEstimate,
    docking.LatchHolds,
    docking.RetreatLeadsAway,
    docking.BrakingEnds,
    processes.NoLossWithoutCause,
    processes.NoCrash,
    processes.MissionEnds,
    estimates.DamageIsNamed,
    docking.DockedTruly,
    docking.UndisturbedDocks,
    docking.DockedOrSafe,
    processes.NoRecordedDataLost,
    processes.BoundedQueues,
    estimates.CovarianceConsistency,
    tracking.TrackingAccuracy,
)
"""All invariants, in the order in which they see a message."""

C = TypeVar("C", bound=Check)


class FlightChecks:
    """Checks one flight, message by message. A violation is recorded once per invariant and
    subject.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.violations: list[Violation] = []
        self.view = FlightView(scenario)
        self._noted: set[tuple[str, str]] = set()
        self._checks = {kind: kind(self.view, self._note) for kind in CHECKS}
        self._readers: dict[type, list[Callable[[Any], None]]] = defaultdict(list)
        for reader in (self.view, *self._checks.values()):
            for kind, read in reader.readers():
                self._readers[kind].append(read)
        self._readers[WorldTruth].append(self._read_steps)

    def find(self, kind: type[C]) -> C:
        """Return the check of a class."""
        check = self._checks[kind]
        assert isinstance(check, kind)
        return check

    def observe(self, sender: str, raw: RawSample) -> None:
        """Check a message when it is published."""
        self.view.receive(sender, raw)
        found = topics.topic_of_key(raw.key)
        try:
            if found is None:
                raise Rejected("key", f"unknown key {raw.key}")
            message = decode_once(found[0].kind, raw.payload, raw.encoding)
        except Rejected as refusal:
            self.find(messages.ValidMessages).refuse(str(refusal))
            return
        for read in self._readers.get(type(message), ()):
            read(message)

    def _read_steps(self, world: WorldTruth) -> None:
        for step in self.view.steps:
            for read in self._readers[type(step)]:
                read(step)

    def end(self, flight: SimulatedFlight) -> None:
        """Check what must hold when the flight is over."""
        for check in self._checks.values():
            check.end(flight)

    @property
    def outcome(self) -> str:
        """Return the first violated invariant, or else the worst final state of the chasers that
        are to dock: ``unfinished``, ``safe`` or ``docked``.
        """
        if self.violations:
            return self.violations[0].invariant
        docked_or_safe = self.find(docking.DockedOrSafe)
        states = {docked_or_safe.state_of(i) for i in docking.chasers_to_dock(self.scenario)}
        return next((s for s in ("unfinished", "safe", "docked") if s in states), "safe")

    def _note(self, invariant: str, subject: str, text: str) -> None:
        if (invariant, subject) not in self._noted:
            self._noted.add((invariant, subject))
            self.violations.append(Violation(invariant, self.view.time_s, f"{subject}: {text}"))
