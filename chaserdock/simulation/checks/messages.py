# SPDX-License-Identifier: Apache-2.0
"""Invariants of single messages beyond what the decoder checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyTruth,
    Odometry,
    Plan,
    Reference,
    Sighting,
    TargetEstimate,
    ThrusterReport,
    WrenchCommand,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.thrusters import thrusts_max

from .check import Check

QUATERNION_ROUNDING = 1e-6
"""Largest deviation of a quaternion's length from 1 by rounding."""
LIMIT_SHARE = 1.01
"""Share of a limit up to which chasers accept commands."""
NO_AUTHORITY = 1e-9
"""Stands for the limit (N, N m) of an axis along which a body on a floor cannot move: a command
along it is wrong, however small.
"""
SYMMETRY = 1e-9
"""Largest asymmetry and negative eigenvalue of a covariance, as a share of its largest variance;
rounding gives less.
"""
LIFETIME_ROUNDING_S = 1e-6
"""Largest difference (s) of a command's lifetime from the stated one: time stamps are in whole
ns.
"""


@dataclass
class ValidMessages(Check):
    """Every message passes the decoder; quaternions are of unit length, covariances symmetric and
    positive semidefinite; commands are within the body's limits and live for
    `controller.command_lifetime_s`; pulses of a thruster do not overlap."""

    name = "valid messages"

    def readers(self) -> Iterator[tuple[type, Callable[[Any], None]]]:
        for kind in DEFECTS:
            yield kind, self.judge

    def judge(self, message: Any) -> None:
        """Judge a message of one of the types in ``DEFECTS``."""
        for text in DEFECTS[type(message)](message, self.scenario):
            self.violate(self.view.key, text)

    def refuse(self, why: str) -> None:
        """Report a message that the decoder rejects."""
        self.violate(self.view.sender, f"{self.view.key}: {why}")


def defects_of(message: Any, scenario: Scenario) -> list[str]:
    """Return the defects of a message, given its scenario; empty if it has none."""
    find = DEFECTS.get(type(message))
    return [] if find is None else list(find(message, scenario))


def covariance_defect(values: Sequence[float]) -> str:
    """Return why a row-major matrix is not a covariance; empty if it is."""
    size = math.isqrt(len(values))
    if size == 3 and _is_covariance_3(*values):
        return ""
    matrix, scale = np.array(values).reshape(size, size), max(map(abs, values))
    if not (matrix == matrix.T).all():
        asymmetry = float(np.abs(matrix - matrix.T).max())
        if asymmetry > SYMMETRY * scale:
            return f"covariance is not symmetric: {asymmetry:.2e} of {scale:.2e}"
    shifted = matrix.copy()
    shifted.reshape(-1)[:: size + 1] += SYMMETRY * scale
    try:
        # The factor exists unless an eigenvalue is below -SYMMETRY * scale; it is faster than
        # eigenvalues.
        np.linalg.cholesky(shifted)
        return ""
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(matrix)[0])
    if least < -SYMMETRY * scale:
        return f"covariance is not positive semidefinite: eigenvalue {least:.2e}"
    return ""


def _is_covariance_3(
    a: float, b: float, c: float, d: float, e: float, f: float, g: float, h: float, i: float
) -> bool:
    """Return whether a row-major matrix (3, 3) is exactly symmetric with positive pivots."""
    if not (b == d and c == g and f == h and a > 0.0):
        return False
    e, f, i = e - b * b / a, f - b * c / a, i - c * c / a
    return e > 0.0 and i - f * f / e > 0.0


def _quaternions(values: Iterable[Sequence[float]]) -> Iterator[str]:
    for q in values:
        if abs(math.hypot(*q) - 1.0) > QUATERNION_ROUNDING:
            yield f"quaternion of length {math.hypot(*q):.9g}"


def _covariances(values: Iterable[Sequence[float]]) -> Iterator[str]:
    yield from filter(None, map(covariance_defect, values))


def _body(body: BodyTruth, scenario: Scenario) -> Iterator[str]:
    yield from _quaternions([body.q_wxyz])


def _odometry(odometry: Odometry, scenario: Scenario) -> Iterator[str]:
    yield from _quaternions([odometry.q_wxyz])
    yield from _covariances(
        [
            odometry.position_covariance_m2,
            odometry.velocity_covariance_m2_s2,
            odometry.attitude_covariance_rad2,
            odometry.omega_covariance_rad2_s2,
        ]
    )


def _sighting(sighting: Sighting, scenario: Scenario) -> Iterator[str]:
    yield from _quaternions(s.q_wxyz for s in sighting.solutions)
    yield from _covariances(s.covariance for s in sighting.solutions)
    if (sighting.status == "seen") != bool(sighting.solutions):
        yield f"status {sighting.status} with {len(sighting.solutions)} solutions"


def _estimate(estimate: TargetEstimate, scenario: Scenario) -> Iterator[str]:
    if estimate.status == "none":
        return
    yield from _quaternions([estimate.q_wxyz, *(r.q_wxyz for r in estimate.relative)])
    yield from _covariances([estimate.covariance, *(r.covariance for r in estimate.relative)])
    if both := set(estimate.accepted) & set(estimate.rejected):
        yield f"sightings of chasers {sorted(both)} are both accepted and rejected"


def _reference(reference: Reference, scenario: Scenario) -> Iterator[str]:
    yield from _quaternions([reference.q_wxyz])
    away_m, most_m = math.hypot(*reference.offset_m), scenario.limits.max_reference_distance_m
    if away_m > most_m * LIMIT_SHARE:
        yield f"reference {away_m:.1f} m from the target, at most {most_m:g} allowed"


def _plan(plan: Plan, scenario: Scenario) -> Iterator[str]:
    stages = len(plan.inputs) // 6
    lengths = len(plan.positions_m), len(plan.quaternions_wxyz), len(plan.inputs)
    if lengths != (3 * (stages + 1), 4 * (stages + 1), 6 * stages):
        yield f"plan of {stages} stages with {lengths} numbers"
        return
    yield from _within_limits(plan.inputs, scenario)


def _within_limits(
    wrenches: Sequence[float], scenario: Scenario, single: bool = False
) -> Iterator[str]:
    """Check wrenches, six numbers each. ``single``: thrusters may be commanded individually, up to
    all in one direction.
    """
    limits, thrusters = scenario.chaser.wrench_max, scenario.chaser.thrusters
    if single:
        limits = np.maximum(limits, np.abs(wrench_matrix(thrusters)) @ thrusts_max(thrusters))
    # No share is allowed of an axis without authority.
    shares = np.abs(np.array(wrenches).reshape(-1, 6)) / np.maximum(limits, NO_AUTHORITY)
    if len(shares) and (share := float(shares.max())) > LIMIT_SHARE:
        yield f"wrench of {share:.3f} of the body's limits"


def _wrench(command: WrenchCommand, scenario: Scenario) -> Iterator[str]:
    yield from _within_limits(
        [*command.force_N, *command.torque_N_m], scenario, bool(command.thrusts_N)
    )
    if command.mode in ("none", "wait", "yield"):
        return
    lifetime_s = (command.expires_ns - command.sim_time_ns) * 1e-9
    stated_s = scenario.controller.command_lifetime_s
    is_wrong = abs(lifetime_s - stated_s) > LIFETIME_ROUNDING_S
    if command.sim_time_ns and is_wrong:  # stamps of a wrong clock end at 0
        yield f"command with a lifetime of {lifetime_s:g} s, {stated_s:g} stated"


def _actuators(command: ActuatorCommand, scenario: Scenario) -> Iterator[str]:
    detumbles = scenario.docking.kind == "capture" and scenario.chaser.actuation == "thrusters"
    yield from _within_limits([*command.force_N, *command.torque_N_m], scenario, detumbles)
    count, closed = len(scenario.chaser.thrusters), {}
    for pulse in sorted(command.pulses, key=lambda p: (p.thruster, p.open_ns)):
        if pulse.thruster >= count or pulse.open_ns >= pulse.close_ns:
            yield f"pulse of thruster {pulse.thruster} from {pulse.open_ns} to {pulse.close_ns} ns"
        if pulse.open_ns < closed.get(pulse.thruster, 0):
            yield f"overlapping pulses of thruster {pulse.thruster}"
        closed[pulse.thruster] = pulse.close_ns


def _report(report: ThrusterReport, scenario: Scenario) -> Iterator[str]:
    yield from _within_limits([*report.force_max_N, *report.torque_max_N_m], scenario)
    if len(report.thrusters) != len(scenario.chaser.thrusters):
        has = len(scenario.chaser.thrusters)
        yield f"states of {len(report.thrusters)} thrusters, the body has {has}"


DEFECTS: dict[type, Callable[[Any, Scenario], Iterator[str]]] = {
    BodyTruth: _body,
    Odometry: _odometry,
    Sighting: _sighting,
    TargetEstimate: _estimate,
    Reference: _reference,
    Plan: _plan,
    WrenchCommand: _wrench,
    ActuatorCommand: _actuators,
    ThrusterReport: _report,
}
"""Functions that find the defects of a message, by its type."""
