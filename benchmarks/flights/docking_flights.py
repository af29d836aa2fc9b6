# SPDX-License-Identifier: Apache-2.0
"""Seeded docking flights of ``docking-contact``: random starts and target rates, flown until
verified or aborted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.messages import OperatorCommand, ProbeTouch
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import PerceptionModel

from . import load_shipped
from .momentum import GroupMomentum, momentum_of

APPROACH_AT_S = 4.0
"""The estimator has settled by then."""
LIMIT_S = 96.0
"""After the approach command: time for three attempts."""
ABORT_WITHIN_S = 42.0
"""After the approach command: without a second attempt, docking is verified by then."""
OPEN_WITHIN_S = 30.0
"""After an abort, the chaser must be back within this time."""
REACHED_M = 0.05
"""Distance from its nominal place within which a chaser that was aborted is back."""
_NEAR_CONTACT_M = 0.015
"""Gap from tip to port below which momentum is measured: before any touch."""
_PAIR = (TARGET, "chaser/0")
"""Bodies that are isolated but for the actuators of the chaser."""

Failure = tuple[str, int, float]
"""A thruster failure: kind, thruster, time in s."""


def docking_scenario(
    seed: int,
    actuation: str = "thrusters",
    rate_hz: int | None = None,
    failure: Failure | None = None,
    changes: tuple[str, ...] = (),
) -> Scenario:
    """Return ``docking-contact`` with a start and target rates drawn from the seed; ``changes`` as
    of ``run --set``.
    """
    rng = np.random.default_rng([seed, 0xD0C])
    paper_omega, paper_velocity = math.hypot(0.015, 0.045, 0.03), math.hypot(0.015, 0.0075, 0.03)

    def random_vector(length: float) -> list[float]:
        direction = rng.normal(size=3)
        return (length * direction / np.linalg.norm(direction)).tolist()

    factor = float(rng.uniform(0.0, 3.0))
    values: dict[str, Any] = {
        "seed": seed,
        "target.omega_rad_s": random_vector(factor * paper_omega),
        "target.velocity_m_s": random_vector(factor * paper_velocity),
        "target.q_wxyz": rotations.normalize(rng.normal(size=4)).tolist(),
        "timeline": [],
        "chaser.actuation": actuation,
    }
    if rate_hz is not None:
        values |= {"time.rate_hz": rate_hz, "time.image_hz": rate_hz}
    if failure is not None:
        kind, thruster, at_s = failure
        values["thruster_failure"] = f"[{{chaser=0,thruster={thruster},at_s={at_s},kind='{kind}'}}]"
    overrides = [*(f"{key}={value}" for key, value in values.items()), *changes]
    scenario = load_shipped("docking-contact", *overrides)
    chaser = scenario.chasers[0].model_copy(
        update={
            "start_offset_m": tuple(rng.uniform(-0.08, 0.08, 3).tolist()),
            "start_rotation_rad": tuple(rng.uniform(-0.08, 0.08, 3).tolist()),
            "start_velocity_m_s": tuple(rng.uniform(-0.01, 0.01, 3).tolist()),
        }
    )
    return scenario.model_copy(update={"chasers": (chaser,)})


class ConservationMission(InProcessMission):
    """Measures the momentum of chaser 0 and target from shortly before contact to 0.5 s after the
    latch has closed.

    The impulse of the actuators is subtracted step by step; ``linear_error`` and ``angular_error``
    are relative.
    """

    def __init__(self, scenario: Scenario, perception: PerceptionModel) -> None:
        super().__init__(scenario, perception)
        self.linear_error: float | None = None
        self.angular_error: float | None = None
        self._initial: GroupMomentum | None = None
        self._impulse, self._angular_impulse = np.zeros(3), np.zeros(3)
        self._steps_left: int | None = None

    def advance(self, step: int) -> None:
        """Advance as any mission does; one step at a time while momentum is measured."""
        near = self.phase(0) in ("final", "contact") and self._gap_m() < _NEAR_CONTACT_M
        if self.linear_error is not None or (self._initial is None and not near):
            super().advance(step)
            return
        if self._initial is None:
            self._initial = momentum_of(self.physics, _PAIR)
            self.take_delivered(0)
        while self.physics.step_count < step:
            self._advance_one_step()

    def _advance_one_step(self) -> None:
        own, centre = self.physics.state("chaser/0"), momentum_of(self.physics, _PAIR).centre_m
        super().advance(self.physics.step_count + 1)
        delivered = self.take_delivered(0).impulse
        impulse = rotations.rotate(own.q_wxyz, delivered[:3])
        moment = np.cross(own.position_m - centre, impulse)
        self._impulse = self._impulse + impulse
        self._angular_impulse = (
            self._angular_impulse + rotations.rotate(own.q_wxyz, delivered[3:]) + moment
        )
        if self._steps_left is not None:
            self._steps_left -= 1
            if self._steps_left == 0:
                self._conclude()
        elif self.physics.latches["chaser/0"].latched:
            self._steps_left = self.scenario.time.physics_hz // 2

    def _gap_m(self) -> float:
        own, target = self.physics.state("chaser/0"), self.physics.state(TARGET)
        centre = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
        port = self.scenario.docking.ports[0]
        reach_m = self.scenario.chaser.probe_reach_m
        return float((centre - np.array(port.position_m)) @ np.array(port.axis)) - reach_m

    def _conclude(self) -> None:
        assert self._initial is not None
        before, after = self._initial, momentum_of(self.physics, _PAIR)
        self.linear_error, self.angular_error = (
            float(np.linalg.norm(new - old - given) / np.linalg.norm(old))
            for old, new, given in (
                (before.linear_N_s, after.linear_N_s, self._impulse),
                (before.angular_N_m_s, after.angular_N_m_s, self._angular_impulse),
            )
        )


@dataclass
class DockingOutcome:
    """How one docking flight ended.

    ``cause``: outcome in a few words. ``touch``: the one at which the latch closed. ``contacts``:
    pairs of bodies that collided. ``peak_m``: the largest distance from the reference on the true
    target between the thruster's ``failure`` and capture. ``thruster_events``: (time in s, text).
    ``verified_again``: whether a second approach after an abort was.
    """

    seed: int
    cause: str
    verified: bool
    touch: ProbeTouch | None
    contacts: set[tuple[str, str]]
    linear_error: float | None = None
    angular_error: float | None = None
    opened_s: float | None = None
    verified_again: bool | None = None
    phase: str = ""
    propellant_kg: float = 0.0
    thruster_events: list[tuple[float, str]] = field(default_factory=list)
    failure: Failure | None = None
    peak_m: float | None = None
    verified_s: float | None = None

    def detection_delay_s(self) -> float | None:
        """Return the time from the thruster's failure to its correct diagnosis; None if there was
        none.
        """
        if self.failure is None:
            return None
        kind, thruster, at_s = self.failure
        diagnosis = f"thruster {thruster} {kind.replace('_', ' ')}: detected"
        return next(
            (t - at_s for t, text in self.thruster_events if text.startswith(diagnosis)), None
        )

    def false_alarms(self) -> int:
        """Return the number of wrong thruster diagnoses."""
        diagnoses = [text for _, text in self.thruster_events if ": detected" in text]
        return len(diagnoses) - (self.detection_delay_s() is not None)

    def line(self) -> str:
        """Return one line for people."""
        text = f"{self.seed}: {self.cause}"
        if self.failure is not None and self.peak_m is not None:
            kind, thruster, at_s = self.failure
            delay_s = self.detection_delay_s()
            detected = "not detected" if delay_s is None else f"detected after {delay_s:.2f} s"
            text += f"; thruster {thruster} {kind} at {at_s:.2f} s, {detected}"
            text += f", peak {self.peak_m * 1e3:.1f} mm"
        if (t := self.touch) is not None:
            text += f"; {t.lateral_m * 1e3:.2f} mm, {math.degrees(t.angle_rad):.3f} deg"
            text += f", {t.closing_m_s * 1e3:.2f} mm/s"
        if self.linear_error is not None and self.angular_error is not None:
            text += f"; momentum errors {self.linear_error:.1e}, {self.angular_error:.1e}"
        if self.opened_s is not None:
            text += f" after {self.opened_s:.1f} s"
            text += (
                "" if self.verified_again is None else f", verified again: {self.verified_again}"
            )
        return text + "".join(f"; {at_s:.2f} s: {event}" for at_s, event in self.thruster_events)


def cause_of(flight: InProcessMission, verified: bool) -> str:
    """Return the outcome in a few words."""
    if flight.contacts:
        return f"collision {sorted(flight.contacts)[0]}"
    retreats = flight.retreats(0)
    kind = retreats[-1].split(": ")[1] if retreats else ""
    if verified:
        return (
            "verified at the first attempt" if not retreats else f"verified after a retreat: {kind}"
        )
    return (
        f"not verified, last retreat: {kind}"
        if retreats
        else f"not verified, phase {flight.phase(0)}"
    )


def order(command: Literal["approach", "abort"]) -> OperatorCommand:
    """Return an operator command to chaser 0."""
    return OperatorCommand(command=command, chaser=0, operator="benchmark")


def dock(
    seed: int,
    scenario: Scenario,
    perception_of: Callable[[Scenario], PerceptionModel],
    failure: Failure | None = None,
    approach_at_s: float = APPROACH_AT_S,
) -> DockingOutcome:
    """Fly one approach until it is verified, or the time limit."""
    ordered, peak_m = False, 0.0
    with ConservationMission(scenario, perception_of(scenario)) as flight:
        while flight.time_s < approach_at_s + LIMIT_S and flight.phase(0) != "verified":
            due = not ordered and flight.time_s >= approach_at_s
            record = flight.step((order("approach"),) if due else ())
            ordered |= due
            if (
                failure is not None
                and record.time_s > failure[2]
                and flight.phase(0) not in ("latched", "verified")
            ):
                peak_m = max(peak_m, record.tracking_errors[0][0])
        verified = flight.phase(0) == "verified"
        cause, verified_s = cause_of(flight, verified), flight.time_s if verified else None
    return DockingOutcome(
        seed,
        cause,
        verified,
        next((t for t in flight.touches if t.latched), None),
        flight.contacts,
        flight.linear_error,
        flight.angular_error,
        propellant_kg=flight.propellant_kg,
        thruster_events=_without_chaser(flight),
        failure=failure,
        peak_m=None if failure is None else peak_m,
        verified_s=verified_s,
    )


def _without_chaser(flight: InProcessMission) -> list[tuple[float, str]]:
    return [(time_s, text) for time_s, _, text in flight.thruster_events]


def offset_error_m(flight: InProcessMission) -> float:
    """Return chaser 0's true distance from its nominal place at the target."""
    own, target = flight.physics.state("chaser/0"), flight.physics.state(TARGET)
    offset = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
    return float(np.linalg.norm(offset - np.array(flight.scenario.chasers[0].position_m)))


def abort(
    seed: int, scenario: Scenario, perception_of: Callable[[Scenario], PerceptionModel], again: bool
) -> DockingOutcome:
    """Fly an approach that is aborted at a random time and, with ``again``, a second one until it
    is verified.
    """
    abort_at_s = APPROACH_AT_S + float(
        np.random.default_rng([seed, 0xAB0]).uniform(0.0, ABORT_WITHIN_S)
    )
    with InProcessMission(scenario, perception_of(scenario)) as flight:
        _step_until(flight, (), lambda: flight.time_s >= APPROACH_AT_S)
        _step_until(flight, (order("approach"),), lambda: flight.time_s >= abort_at_s)
        phase = flight.phase(0)
        flight.step((order("abort"),))
        opened_s = None
        while flight.time_s < abort_at_s + OPEN_WITHIN_S and opened_s is None:
            flight.step()
            if flight.phase(0) == "hold" or offset_error_m(flight) < REACHED_M:
                opened_s = flight.time_s - abort_at_s
        verified = None
        if again and opened_s is not None:
            limit_s = flight.time_s + LIMIT_S
            _step_until(
                flight,
                (order("approach"),),
                lambda: flight.time_s >= limit_s or flight.phase(0) == "verified",
            )
            verified = flight.phase(0) == "verified"
    cause = f"aborted in {phase}: " + ("opened" if opened_s is not None else "NOT opened")
    if flight.contacts:
        cause += ", COLLISION"
    return DockingOutcome(
        seed,
        cause,
        bool(verified),
        None,
        flight.contacts,
        opened_s=opened_s,
        verified_again=verified,
        phase=phase,
        thruster_events=_without_chaser(flight),
    )


def _step_until(
    flight: InProcessMission, commands: tuple[OperatorCommand, ...], done: Callable[[], bool]
) -> None:
    """Fly one tick with ``commands``, then ticks without, until ``done``."""
    flight.step(commands)
    while not done():
        flight.step()
