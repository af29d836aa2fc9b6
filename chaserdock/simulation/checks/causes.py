# SPDX-License-Identifier: Apache-2.0
"""What a scenario's faults and network explain, by mission time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.faults import Fault

LATE_JITTERS = 6.0
"""Delay of a tick's three messages by jitter that counts as possible, in mean jitters. The sum of
three exponential delays exceeds it once in 16 ticks: exp(-6) (1 + 6 + 6^2 / 2) = 0.062.
"""
FOLLOWING_S = 3.0
"""Time (s) after a disturbance until chasers again fly commands, and those of the same controller:
three times what a new holder of a lease has for its first command (docs/redundancy.md). Larger:
slow recovery passes; smaller: allowed recovery fails.
"""
SETTLING_S = 15.0
"""Least time (s) after the last warning or command before a chaser must have docked or be safe, and
after a lie of sensors before the estimate must be honest. Larger: fewer flights are judged;
smaller: recoveries in progress fail. An approach takes longer.
"""
STOPPING_S = 3.0
"""Time (s) in which a moving chaser stops from the speeds of an approach, as long as guidance takes
to stop its reference.
"""
DEVICES_SETTLE_S = 2.0
"""Time (s) after a fault until thrusters again give what is commanded. Delayed messages arrive
within 1 s (`swarm.py`).
"""

HARMLESS = frozenset({"camera_off", "lying_sensor", "odometry_lie", "duplicate"})
"""Kinds of faults after which a chaser still flies commands."""
WRONG_STATES = frozenset({"odometry_lie", "clock_jump", "corrupt"})
"""Kinds of faults after which a chaser states a wrong pose of its own although its sensor does not
lie.
"""

IN_LATE_NETWORK = "in a network that loses messages or delays them by more than half a tick"
"""Condition of ``Causes.late_messages``, as a text for exceptions."""


class Causes:
    """What a scenario's faults and network explain. Times are mission times (s).

    ``late_messages``: the network loses messages, or delays them so that leases may run out.
    ``liars``: chasers whose sensor lies at some time. ``honest``: no sensor lies, and bodies and
    thrusters are as stated; the covariance of the estimate should then be consistent.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.faults, self.network = scenario.fault, scenario.simulation
        self._chasers = len(scenario.chasers)
        self._thrusters_fail = bool(scenario.thruster_failure)
        s = self.network
        # The messages of a tick cross the network three times; this may take longer than half a
        # tick.
        late_s = 3.0 * s.latency_s + LATE_JITTERS * s.jitter_s
        is_late = s.loss or s.reorder or late_s > 0.5 / scenario.time.rate_hz
        self.late_messages = s.mode == "realtime" and bool(is_late)
        self.liars = {f.process for f in self.faults if f.kind == "lying_sensor"}
        self.wrong_states = any(f.kind in WRONG_STATES for f in self.faults)
        altered = self._thrusters_fail or "truth" in scenario.model_fields_set
        self.honest = not (self.liars or self.wrong_states or altered)

    def misleads(self, now_s: float) -> bool:
        """Return whether the sensors of half of the chasers lie, or lied less than ``SETTLING_S``
        ago. Who is honest cannot be known then.
        """
        lies = (f for f in self.faults if f.kind == "lying_sensor")
        recent = {f.process for f in lasting(lies, now_s, SETTLING_S)}
        return 2 * len(recent) >= self._chasers

    def loses(self, now_s: float) -> bool:
        """Return whether a fault or the network explains that a process is lost."""
        begun = any(f.at_s <= now_s for f in self.faults)
        return bool(self.late_messages or self.network.slow or self.network.partition or begun)

    def hands_over(self, now_s: float) -> bool:
        """Return whether the network, or a fault within the last ``FOLLOWING_S``, explains that
        the other controller commands."""
        harmful = (f for f in self.faults if f.kind not in HARMLESS)
        return self.late_messages or self._lasted(harmful, now_s, FOLLOWING_S)

    def disturbs_thrusters(self, now_s: float) -> bool:
        """Return whether thrusters may give something other than commanded, because of failures,
        lost or late messages, or recent faults, partitions or slow readers.
        """
        recent = self._lasted(self.faults, now_s, DEVICES_SETTLE_S)
        return bool(self._thrusters_fail or recent or self.late_messages)

    def keep_commands_until_s(self, name: str, now_s: float) -> float:
        """Return the time until which faults or the network have kept commands from a chaser, or
        made it refuse them; at most ``now_s``, 0 if never.
        """
        return self.lasted_until_s((f for f in self.faults if keeps_commands(f, name)), now_s)

    def lasted_until_s(self, faults: Iterable[Fault], now_s: float) -> float:
        """Return the time until which one of the faults, a partition or a slow reader has lasted;
        at most ``now_s``, 0 if none has begun.
        """
        spans = [(f.at_s, f.at_s + (f.duration_s or 0.0)) for f in faults]
        windows = (*self.network.partition, *self.network.slow)
        spans += [(w.at_s, w.at_s + w.duration_s) for w in windows]
        return max([0.0, *(min(end_s, now_s) for at_s, end_s in spans if at_s <= now_s)])

    def _lasted(self, faults: Iterable[Fault], now_s: float, after_s: float) -> bool:
        """Return whether one of the faults, a partition or a slow reader lasts, or ended at most
        ``after_s`` ago.
        """
        until_s = self.lasted_until_s(faults, now_s)
        return until_s > 0.0 and now_s - until_s <= after_s


def keeps_commands(fault: Fault, name: str) -> bool:
    """Return whether a fault may keep commands from a chaser, or make it refuse them."""
    return fault.kind not in HARMLESS and fault.process in (name, "world", "controller", "standby")


def lasting(faults: Iterable[Fault], now_s: float, after_s: float) -> Iterator[Fault]:
    """Yield the faults that last now or ended at most ``after_s`` ago."""
    for f in faults:
        if f.at_s <= now_s <= f.at_s + (f.duration_s or 0.0) + after_s:
            yield f
