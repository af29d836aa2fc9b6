"""What capture does to the controller's image of the world: who holds on to the target, and how that moves then."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import DockingStatus, Odometry
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.bodies import cuboid_inertia

from chaserdock_controller.estimation.target_body import TargetBody, TargetPath, attach_bodies, predict_path
from chaserdock_controller.estimation.types import Estimator, Shock, TargetState
from chaserdock_controller.output.latency_compensation import CommandHistory

from . import reference
from .docking import DockingObservation

# One sigma of what a touch, and the shock of a capture at the tolerances' speed, may do to the target's rates
# (m/s, rad/s); share of the known effect of a pull that may be otherwise; and with thrusters, one of which may have failed
# unknown to all, share of the impulse that may be otherwise, wherever it acts.
_TOUCH = Shock(0.005, 0.01)
_PULL_UNKNOWN = 0.1
_THRUSTERS_UNKNOWN = 1.0


def target_body(scenario: Scenario) -> TargetBody:
    """The target as the scenario describes it, alone."""
    target = scenario.target
    inertia = target.inertia_kg_m2 or cuboid_inertia(target.mass_kg, scenario.target_model().size_m)
    return TargetBody(target.mass_kg, np.diag(inertia), np.zeros(3))


class Captures:
    """Who holds on (``latched``), and the body that the target has become by it."""

    def __init__(self, scenario: Scenario, estimator: Estimator) -> None:
        self._scenario = scenario
        self._estimator = estimator
        self._alone = target_body(scenario)
        self._free = scenario.target.motion == "torque_free"
        self.body = self._alone
        self.latched: frozenset[int] = frozenset()
        self._changed = False

    def feel(
        self,
        told: Mapping[int, DockingStatus],
        odometry: Mapping[int, Odometry],
        history: CommandHistory,
        now_ns: int,
        given: Mapping[int, Array],
    ) -> None:
        """Takes in what the docking sensors say, before this tick's sightings: the target may have been pushed.

        ``history``: commands sent; those of a chaser that holds on have moved the target as well. ``given``: impulses
        (6,), body axes, since the tick before, of chasers that tell: pulses are not where their commands are.
        """
        latched = self.latched - told.keys() | {i for i, status in told.items() if status.latched}
        changed = latched != self.latched
        if changed or any(s.contact and not s.latched for s in told.values()):
            self._estimator.disturb(_TOUCH)
        else:
            for i in sorted(latched & odometry.keys()):
                if i in given:
                    self._pushed(odometry[i], given[i], now_ns, _THRUSTERS_UNKNOWN)
                else:
                    self._pushed(odometry[i], self._commanded(i, history, now_ns), now_ns)
        self._changed |= changed
        self.latched = latched

    def _commanded(self, i: int, history: CommandHistory, now_ns: int) -> Array:
        """Impulse (6,), body axes, that the commands to chaser ``i`` are since the tick before."""
        since_ns = now_ns - round(1e9 / self._scenario.time.rate_hz)
        segments = history.segments(i, since_ns, now_ns)
        return sum((w * ((end - begin) / 1e9) for begin, end, w in segments), np.zeros(6))

    def _pushed(self, odometry: Odometry, impulse: Array, now_ns: int, unknown: float = 0.0) -> None:
        """What a chaser that holds on has done to the common body's rates by an ``impulse`` (6,), body axes.

        ``unknown``: share of the impulse that may have been in any other direction.
        """
        if not impulse.any():
            return
        before = self._estimator.estimate_at(now_ns)
        centre, q = pose_in_target(before, odometry)
        force, torque = rotations.rotate(q, impulse[:3]), rotations.rotate(q, impulse[3:])
        torque = torque + rotations.cross(centre - self.body.centre_trf_m, force)
        omega = np.asarray(np.linalg.solve(self.body.inertia_kg_m2, torque), dtype=np.float64)
        moved = force / self.body.mass_kg - rotations.cross(omega, self.body.centre_trf_m)
        velocity = rotations.rotate(before.q_wxyz, moved)
        sigmas = [_PULL_UNKNOWN * float(np.linalg.norm(v)) for v in (velocity, omega)]
        if unknown > 0.0:
            other = unknown * float(np.linalg.norm(force))
            arm_m = float(np.linalg.norm(centre - self.body.centre_trf_m))
            turned = other * arm_m / float(np.linalg.eigvalsh(self.body.inertia_kg_m2)[-1])
            away_m = float(np.linalg.norm(self.body.centre_trf_m))
            sigmas[0] = math.hypot(sigmas[0], other / self.body.mass_kg, turned * away_m)
            sigmas[1] = math.hypot(sigmas[1], turned)
        self._estimator.disturb(Shock(sigmas[0], sigmas[1], velocity, omega))

    def join(self, fused: TargetState, odometry: dict[int, Odometry]) -> None:
        """After this tick's sightings: if somebody has latched or let go, the target is another body from now on.

        The held chasers' masses and the target's are the scenario's, where they hold it is estimated.
        """
        if not self._changed or not self.latched <= odometry.keys():
            return
        chaser = self._scenario.chaser
        held = []
        for i in sorted(self.latched):
            centre, attitude = pose_in_target(fused, odometry[i])
            held.append((chaser.mass_kg, np.asarray(chaser.inertia), centre, attitude))
        self.body = attach_bodies(self._alone, held)
        rows = self.body.inertia_kg_m2.tolist()
        centre = self.body.centre_trf_m.tolist()
        self._estimator.change_body((tuple(rows[0]), tuple(rows[1]), tuple(rows[2])), tuple(centre))
        self._changed = False

    def path(self, ahead: TargetState, step_s: float, steps: int) -> tuple[TargetPath, TargetPath]:
        """The target from the estimate ``ahead`` on: at 0, step_s, ... steps * step_s, and in the middles between."""
        state = (ahead.position_m, ahead.velocity_m_s, ahead.q_wxyz, ahead.omega_rad_s)
        if self._free:
            fine = predict_path(self.body, *state, step_s / 2, 2 * steps)
            return fine.every_second(0), fine.every_second(1)
        times_s = np.arange(steps + 1) * step_s
        both_s = np.concatenate([times_s, times_s[:-1] + step_s / 2])
        positions, attitudes = reference.predict_target(*state, both_s)
        still = np.zeros((steps + 1, 3))
        rates, k = still + ahead.omega_rad_s, steps + 1
        nodes = TargetPath(positions[:k], attitudes[:k], rates, still, still)
        return nodes, TargetPath(positions[k:], attitudes[k:], rates[1:], still[1:], still[1:])

    def senses(
        self, i: int, fused: TargetState, odometry: Odometry, told: DockingStatus | None
    ) -> DockingObservation | None:
        """What guidance wants to know of a chaser at its port; None where it has none."""
        s = self._scenario
        port = s.docking.port_of(i)
        if port is None:
            return None
        chaser = BodyState(
            np.array(odometry.position_m),
            np.array(odometry.velocity_m_s),
            np.array(odometry.q_wxyz),
            np.array(odometry.omega_rad_s),
        )
        target = BodyState(fused.position_m, fused.velocity_m_s, fused.q_wxyz, fused.omega_rad_s)
        view = view_of(port, s.chaser.probe_reach_m, np.asarray(s.chasers[i].q_wxyz), chaser, target)
        contact = told is not None and told.contact
        return DockingObservation(view, contact, i in self.latched, *pose_in_target(fused, odometry))


def pose_in_target(fused: TargetState, odometry: Odometry) -> tuple[Array, Array]:
    """A chaser's estimated centre (3,) and attitude (4,) in TRF."""
    centre = rotations.rotate_inverse(fused.q_wxyz, np.array(odometry.position_m) - fused.position_m)
    return centre, rotations.multiply(rotations.conjugate(fused.q_wxyz), odometry.q_wxyz)
