# SPDX-License-Identifier: Apache-2.0
"""Invariants of docking: latches hold, retreats lead away, chasers dock or are safe."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import numpy as np
from chaserdock_controller.guidance.trajectories import PEAK_SPEED
from chaserdock_controller.ingest.lost_chasers import MOST_M as LOST_MARGIN_M
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_protocol.messages import ActuatorCommand, Event, Reference, WorldTruth
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.faults import LATCH_FAULTS

from ..mission import SimulatedFlight
from .causes import SETTLING_S, STOPPING_S, lasting
from .check import Check
from .estimates import ACCURACY_M, DRIFT_SIGMAS
from .flight_view import FlightView
from .reader import reads

RETREAT_SLACK_M = 0.15
"""Distance (m) by which the reference of a retreat may at first come closer to the target. One that
moves inwards at up to 8 cm/s turns within it.
"""
TURNING_S = 5.0
"""Time (s) after which a retreat must lead to the nominal place; longer than a turn. Larger:
detours pass; smaller: slow turns fail.
"""
HOMING_SLACK_M = 0.03
"""Distance (m) by which a retreat may move away from its goal again, by noise of its reference."""

LATCH_DELAY_S = 1.0
"""Time (s) after a fault of a latch within which it may open. Larger: an opening without a cause
passes; smaller: late messages fail.
"""
BRAKING_S = 20.0
"""Longest time (s) for which a chaser without a controller brakes: 15 s, after which its fallback
stops braking, plus 5 s.
"""

DRIFT_ERROR_M = 0.1
"""Largest error (m) of the extrapolated position of a lost chaser. Larger: more flights count as
blocked; smaller: chasers that avoid it fail.
"""

SAFE_PHASES = frozenset(
    {"hold", "retreat", "abort", "wait", "searching", "acquire", "goto", "calibrate", "inspect"}
)
"""Phases in which a chaser keeps its distance. They count as safe if the log states their
reason.
"""
NAMED_IN = ("hold", "retreat", "abort", "goto", "calibrate", "inspect")
"""Operator commands that are such a reason."""
ATTACHED = frozenset({"latched", "verified", "identify", "detumble", "stack_hold"})
"""Phases in which the latch of a chaser is to be closed."""
DOCKED = ATTACHED | {"docked"}


@dataclass
class LatchHolds(Check):
    """A closed latch opens in no phase in which it is to hold."""

    name = "latch holds"
    exceptions = (
        f"a fault of the latch, and {LATCH_DELAY_S:g} s after it",
        "a latch of limited strength (`[truth.latch]`)",
    )

    _latched: set[int] = field(default_factory=set)

    @reads(WorldTruth)
    def judge(self, world: WorldTruth) -> None:
        now = set(world.latched)
        for i in self._latched - now:
            phase = self.view.phases.get(i, "")
            if phase in ATTACHED and not self._may_open(i):
                self.violate(f"chaser/{i}", f"its latch opens in phase {phase}")
        self._latched = now

    def _may_open(self, i: int) -> bool:
        faults = (
            f for f in self.scenario.fault if f.kind in LATCH_FAULTS and f.process == f"chaser/{i}"
        )
        is_disturbed = any(lasting(faults, self.view.time_s, LATCH_DELAY_S))
        return is_disturbed or "latch" in self.scenario.truth.model_fields_set


@dataclass
class RetreatLeadsAway(Check):
    """In `retreat` and `abort` the reference comes no nearer to the target than where it began,
    less ``RETREAT_SLACK_M``. After ``TURNING_S`` it comes no farther than it was under the same
    controller, plus ``HOMING_SLACK_M``, from the chaser's nominal place or from the entry of its
    corridor, from which it may try again."""

    name = "retreat leads away"
    exceptions = ("from the far side of the target, where the way back passes it",)

    _phases: dict[int, str] = field(default_factory=dict)
    _nearest_m: dict[int, float] = field(default_factory=dict)
    """Least allowed distance from the target, in its present phase, of each chaser's reference."""
    _least_m: dict[int, tuple[str, Array]] = field(default_factory=dict)
    """Least distances (1 or 2,) so far from the goals of each chaser's retreat, and under which
    controller.
    """

    def begin(self) -> None:
        self._goals_m = [retreat_goals(self.scenario, i) for i in range(len(self.scenario.chasers))]

    @reads(Reference)
    def judge(self, reference: Reference) -> None:
        i, away_m = reference.chaser, math.hypot(*reference.offset_m)
        if self._phases.get(i) != reference.phase:
            self._phases[i] = reference.phase
            nominal_m = self.scenario.chasers[i].position_m
            is_near_side = np.dot(reference.offset_m, nominal_m) > 0.0
            nearest_m = min(away_m, math.hypot(*nominal_m)) - RETREAT_SLACK_M
            self._nearest_m[i] = nearest_m if is_near_side else 0.0
            self._least_m.pop(i, None)
        if reference.phase not in ("retreat", "abort"):
            return
        if reference.phase_time_s > TURNING_S:
            self._judge_homing(i, reference)
        if away_m < self._nearest_m[i]:
            self.violate(f"chaser/{i}", f"its reference is {away_m:.2f} m from the target")

    def _judge_homing(self, i: int, reference: Reference) -> None:
        """Judge the distances from the goals. Controllers start a retreat from their own estimates,
        so that after a hand-over it may lead less far.
        """
        sender = self.view.sender
        left_m = np.linalg.norm(self._goals_m[i] - reference.offset_m, axis=1)
        known_sender, least_m = self._least_m.get(i, (sender, left_m))
        least_m = np.minimum(left_m, least_m) if known_sender == sender else left_m
        self._least_m[i] = sender, least_m
        if np.all(left_m > least_m + HOMING_SLACK_M):
            way = f"{left_m[0]:.2f} m from its nominal place, after {least_m[0]:.2f} m"
            self.violate(f"chaser/{i}", f"its reference is {way}")


@dataclass
class BrakingEnds(Check):
    """A chaser that controls itself without a controller brakes for at most ``BRAKING_S``."""

    name = "liveness"
    exceptions = (
        "a latched chaser, or one without odometry: neither pushes",
        "a chaser that no command reaches",
        "with thruster failures",
    )

    _since_s: dict[int, float] = field(default_factory=dict)

    @reads(ActuatorCommand)
    def judge(self, command: ActuatorCommand) -> None:
        i, name, now_s = command.chaser, f"chaser/{command.chaser}", self.view.time_s
        pushes = any((*command.force_N, *command.torque_N_m)) and i not in self.view.latched
        is_judged = name not in self.view.unreachable and not self.scenario.thruster_failure
        if command.source != "brake" or not pushes or not is_judged:
            self._since_s.pop(i, None)
        elif (lasting_s := now_s - self._since_s.setdefault(i, now_s)) > BRAKING_S:
            self.violate(name, f"brakes for {lasting_s:.0f} s")


@dataclass
class DockedTruly(Check):
    """At the end a chaser in phase `latched`, `verified` or one that follows is latched, and one in
    phase `docked` is truly within `approach.docked_position_m`, ``ACCURACY_M`` and
    ``DRIFT_SIGMAS`` standard deviations of the drift of odometry of its docking place."""

    name = "liveness"
    exceptions = (
        "a chaser that no command reaches",
        "a docked one that has fallen back to its own control since",
    )

    def end(self, flight: SimulatedFlight) -> None:
        view, s = self.view, self.scenario
        if view.mission_end is None:
            return
        drift_m = s.navigation.errors().position_drift_m
        within_m = s.approach.docked_position_m + ACCURACY_M + DRIFT_SIGMAS * drift_m
        for chaser in chasers_to_dock(s):
            phase, name = view.phases.get(chaser, ""), f"chaser/{chaser}"
            is_open = chaser not in view.latched and name not in view.unreachable
            if phase in ATTACHED and is_open:
                self.violate(name, f"is in phase {phase}, but its latch is open")
            place, own = docking_place(view, chaser), view.states.get(name)
            if phase != "docked" or view.is_on_its_own(chaser) or place is None or own is None:
                continue
            if (error_m := math.dist(place, own.position_m)) > within_m:
                text = f"is in phase docked, but {error_m:.3f} m from its docking place"
                self.violate(name, text)


@dataclass
class UndisturbedDocks(Check):
    """Where nothing disturbs a mission, each chaser that is to dock has docked at its end."""

    name = "liveness"
    exceptions = (
        "with faults, thruster failures or `[truth]`",
        "with losses, reordering, partitions, slow readers or other clocks",
        "with commands of an operator, but to approach",
    )

    def end(self, flight: SimulatedFlight) -> None:
        if self.view.mission_end is None or self._is_disturbed():
            return
        for chaser in chasers_to_dock(self.scenario):
            phase = self.view.phases.get(chaser, "")
            if phase not in DOCKED:
                text = f"ends in phase {phase or 'none'}, although nothing disturbed it"
                self.violate(f"chaser/{chaser}", text)

    def _is_disturbed(self) -> bool:
        s = self.scenario
        network = s.simulation.model_dump(exclude={"mode", "latency_s", "jitter_s", "duplicate"})
        commands = {e.command for e in s.timeline} - {"approach"}
        plant = s.thruster_failure or "truth" in s.model_fields_set
        return bool(s.fault or commands or plant or any(network.values()))


@dataclass
class DockedOrSafe(Check):
    """At the end each chaser that is to dock, and is commanded to approach, has docked or is safe:
    no command reaches it, or it keeps its distance, by its phase or by its own control, and a
    warning, a command or a phase names the reason. Reasons count that the chaser itself states, or
    world or controllers about it or about all."""

    name = "liveness"
    exceptions = (
        "if the last of these reasons or commands was less than the time of an approach before the "
        "end: the outcome is `unfinished`",
        "if a lost chaser drifts so near that the others avoid it: `unfinished`, too",
    )

    _reason_s: dict[int, float] = field(default_factory=dict)
    """Time (s) of the last logged reason that concerns each chaser."""

    @reads(Event)
    def note_reason(self, event: Event) -> None:
        # Guidance logs the reason of a phase that it chose: "chaser 0: hold (from approach:
        # REASON)".
        is_chosen = ": " in event.what.partition("(from ")[2]
        is_warning = event.level != "info" and not event.what.startswith("fault ")
        if is_warning or is_chosen:
            chasers = concerned(event, len(self.scenario.chasers))
            self._reason_s |= dict.fromkeys(chasers, self.view.time_s)

    def end(self, flight: SimulatedFlight) -> None:
        if self.view.mission_end is None:
            return
        for chaser in chasers_to_dock(self.scenario):
            if not self.state_of(chaser):
                phase = self.view.phases.get(chaser) or "none"
                self.violate(f"chaser/{chaser}", f"ends in phase {phase} without a named reason")

    def state_of(self, chaser: int) -> str:
        """Return how a chaser that is to dock ends: ``docked``, ``safe`` or ``unfinished``; empty
        if it is not to dock.
        """
        view = self.view
        phase, is_on_its_own = view.phases.get(chaser, ""), view.is_on_its_own(chaser)
        if phase in DOCKED and not is_on_its_own:
            return "docked"
        commands = [e for e in self.scenario.timeline if chaser in e.chasers]
        is_named = chaser in self._reason_s or any(e.command in NAMED_IN for e in commands)
        keeps_distance = phase in SAFE_PHASES or is_on_its_own
        if f"chaser/{chaser}" in view.unreachable or (is_named and keeps_distance):
            return "safe"
        if phase in SAFE_PHASES:
            return ""
        last_s = max(self._reason_s.get(chaser, 0.0), *(e.at_s for e in commands), 0.0)
        had_time = view.time_s - last_s >= settling_s(self.scenario, chaser)
        return "" if had_time and not self._is_blocked(chaser) else "unfinished"

    def _is_blocked(self, chaser: int) -> bool:
        """Return whether a lost chaser drifts so close to the docking place, or to a chaser with a
        port, that others avoid it.
        """
        view = self.view
        own = view.states.get(f"chaser/{chaser}")
        has_port = self.scenario.docking.port_of(chaser) is not None
        place = own.position_m if has_port and own is not None else docking_place(view, chaser)
        near_m = self.scenario.limits.min_distance_chasers_m + LOST_MARGIN_M + DRIFT_ERROR_M
        lost = [state.position_m for name, state in view.states.items() if name in view.lost]
        return place is not None and any(math.dist(place, at) < near_m for at in lost)


def chasers_to_dock(s: Scenario) -> list[int]:
    """Return the chasers that are to dock or latch and are commanded to approach before the end;
    without those whose port is chosen in flight, for which there may be none.
    """
    rows = [e for e in s.timeline if e.command == "approach" and e.at_s < s.duration_s]
    approaching = {i for e in rows for i in e.chasers if not s.chooses_port(i)}
    return sorted(approaching & {*s.success.docked, *s.success.latched})


def concerned(event: Event, chasers: int) -> set[int]:
    """Return the chasers that an event may keep from docking: its publisher, or those that world or
    controllers name; all if none is named.
    """
    if event.process.startswith("chaser/"):
        return {int(event.process.partition("/")[2])}
    named = {int(i) for i in re.findall(r"chaser[ /](\d+)", f"{event.what} {event.detail}")}
    if event.process == "recorder" or event.detail == "recorder":
        return set()
    return named or set(range(chasers))


def docking_place(view: FlightView, chaser: int) -> Array | None:
    """Return the true place (WRF, m) where a chaser without a port docks; None while the truth is
    unknown.
    """
    target = view.states.get("target")
    if target is None:
        return None
    nominal_m = np.array(view.scenario.chasers[chaser].position_m)
    dock_m = view.scenario.approach.dock_distance_m
    offset_m = nominal_m * (dock_m / math.hypot(*nominal_m))
    return target.position_m + rotations.rotate(np.array(target.q_wxyz), offset_m)


def retreat_goals(s: Scenario, chaser: int) -> Array:
    """Return the goals (1 or 2, 3), TRF, of a retreat: the nominal place, and the entry of the
    corridor to a port.
    """
    port, goals_m = s.docking.port_of(chaser), [np.array(s.chasers[chaser].position_m)]
    if port is not None:
        goals_m.append(centre_offset(port, s.chaser.probe_reach_m, s.docking.entry_m))
    return np.array(goals_m)


def settling_s(s: Scenario, chaser: int) -> float:
    """Return how long (s) a chaser may take after the last disturbance, for an approach from rest
    or another attempt.
    """
    d, approach = s.docking, s.approach
    if d.port_of(chaser) is None:
        way_m = math.hypot(*s.chasers[chaser].position_m) - approach.dock_distance_m
        moving_s = PEAK_SPEED * max(0.0, way_m) / approach.max_speed_m_s
        return max(SETTLING_S, STOPPING_S + moving_s + approach.docked_time_s)
    out_s = d.entry_m / approach.max_speed_m_s
    in_s = (d.entry_m - d.final_m) / d.approach_speed_m_s
    contact_s = (d.final_m + d.overdrive_m) / d.contact_speed_m_s
    return SETTLING_S + out_s + (in_s + contact_s) + d.settle_s + 2.0 * d.pull_s
