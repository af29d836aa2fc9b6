# SPDX-License-Identifier: Apache-2.0
"""References of the chasers, now and over the NMPC horizon."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.shape_distance import box_table, moved
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.estimation.target_body import TargetBody, TargetPath, predict_path
from chaserdock_controller.estimation.types import RelativePose, TargetState
from chaserdock_controller.interfaces import HorizonReference, ReferencePose

from . import reference
from .approach_cone import corridor_rows
from .phase_machine import PhaseMachine
from .trajectories import Escape

_GREATEST_MARGIN_M = 0.1


def target_path(
    body: TargetBody, torque_free: bool, start: TargetState, step_s: float, steps: int
) -> TargetPath:
    """Return the target's predicted motion at 0, step_s, ... steps * step_s, and then in the
    middles between.
    """
    state = (start.position_m, start.velocity_m_s, start.q_wxyz, start.omega_rad_s)
    if torque_free:
        path = predict_path(body, *state, step_s / 2, 2 * steps)
        return path.at(np.concatenate([np.arange(0, 2 * steps + 1, 2), np.arange(1, 2 * steps, 2)]))
    times_s = np.arange(steps + 1) * step_s
    both_s = np.concatenate([times_s, times_s[:-1] + step_s / 2])
    positions, attitudes = reference.predict_target(*state, both_s)
    zeros = np.zeros((len(both_s), 3))
    return TargetPath(positions, attitudes, zeros + start.omega_rad_s, zeros, zeros)


class ReferenceBuilder:
    """Computes references from the moves and phases of a phase machine."""

    def __init__(self, scenario: FlightScenario, machine: PhaseMachine) -> None:
        self._scenario, self._machine = scenario, machine
        self._step_s = scenario.controller.dt_s
        self._stages = round(scenario.controller.horizon_s / scenario.controller.dt_s)
        keeps = scenario.limits.min_distance_shape_m > 0.0
        self._boxes = box_table(scenario.target_model().boxes) if keeps else None

    def pose(self, i: int, target: TargetState, now_s: float) -> tuple[Array, Array, Array]:
        """Return a chaser's reference now: position (3,) and attitude (4,) in WRF, offset (3,) in
        TRF.
        """
        move = self._machine.chasers[i].move
        offset = move.at(np.array([now_s]))[0][0]
        if isinstance(move, Escape):
            offset = rotations.rotate_inverse(target.q_wxyz, offset)
        position = target.position_m + rotations.rotate(target.q_wxyz, offset)
        q_off = self._attitudes(i, offset[None], np.array([now_s])).reshape(4)
        return position, rotations.multiply(target.q_wxyz, q_off), offset

    def reference(self, i: int, pose: tuple[Array, Array, Array]) -> ReferencePose:
        """Return a reference pose with the distance that the chaser keeps from the target."""
        return ReferencePose(*pose, self._machine.min_distance_target_m(i))

    def horizon(
        self,
        chasers: tuple[int, ...],
        start: TargetState,
        body: TargetBody,
        attached: frozenset[int],
        relative: Sequence[RelativePose] = (),
    ) -> HorizonReference:
        """Return the references of ``chasers`` from the time of ``start`` on.

        ``relative``: poses relative to the target, whose covariance widens the distance to keep
        from it.
        """
        s, step_s = self._scenario, self._step_s
        torque_free = s.target.motion == "torque_free"
        path, k = target_path(body, torque_free, start, step_s, self._stages), self._stages + 1
        nodes, middles = path.at(slice(k)), path.at(slice(k, None))
        times_s = start.time_ns / 1e9 + np.arange(k, dtype=float) * step_s
        both_s = np.concatenate([times_s, times_s[:-1] + step_s / 2])
        (positions, velocities, accelerations), q_off = self._offsets(chasers, both_s, path)
        u_ref = np.zeros((len(chasers), self._stages, 6))
        if s.controller.feed_forward:
            u_ref = reference.feed_forward(
                middles.omega_rad_s,
                positions[:, k:],
                velocities[:, k:],
                accelerations[:, k:],
                q_off[:, k:],
                s.chaser.mass_kg,
                np.diag(s.chaser.inertia),
                middles.alpha_rad_s2,
                middles.acceleration_m_s2,
            )
        known = {r.chaser: r for r in relative}
        margins = self._margins_m(
            [known[i].covariance if i in known else start.covariance for i in chasers]
        )
        distances = np.array([self._machine.min_distance_target_m(i) for i in chasers])
        # An uncertain pose pushes no chaser out of the corridor of its port, where no other place
        # is safe.
        room = [
            length(known[i].position_m) - d
            if i in known and self._machine.in_corridor(i)
            else np.inf
            for i, d in zip(chasers, distances.tolist(), strict=True)
        ]
        distances = distances + np.minimum(margins, np.maximum(room, 0.0))
        boxes = clearance = None
        if self._boxes is not None:
            boxes = moved(self._boxes, nodes.positions_m, nodes.q_wxyz)
            kept = np.array([self._machine.min_distance_shape_m(i) for i in chasers])
            clearance = np.where(kept > 0.0, kept + margins, 0.0)
        return HorizonReference(
            chasers=chasers,
            references=reference.references_on(
                nodes.positions_m, nodes.q_wxyz, positions[:, :k], q_off[:, :k]
            ),
            u_ref=u_ref,
            target_positions=nodes.positions_m,
            min_distance_target_m=distances,
            corridors=corridor_rows([self._machine.corridor(i) for i in chasers], nodes.q_wxyz),
            attached=attached,
            boxes=boxes,
            box_clearance_m=clearance,
        )

    def _offsets(
        self, chasers: tuple[int, ...], times_s: Array, target: TargetPath
    ) -> tuple[tuple[Array, Array, Array], Array]:
        """Return offsets, their velocities and accelerations in TRF, each (N, K, 3), and attitudes,
        body to TRF, (N, K, 4), at times (K,), at which the target moves as ``target``."""
        moves = [self._motion(i, times_s, target) for i in chasers]
        q_off = np.empty((len(chasers), len(times_s), 4))
        for row, i in enumerate(chasers):
            q_off[row] = rotations.normalize(self._attitudes(i, moves[row][0], times_s))
        positions, velocities, accelerations = (np.array(part) for part in zip(*moves, strict=True))
        return (positions, velocities, accelerations), q_off

    def _motion(self, i: int, times_s: Array, target: TargetPath) -> tuple[Array, Array, Array]:
        """Return a chaser's offsets, velocities and accelerations (K, 3) in TRF at times (K,)."""
        move = self._machine.chasers[i].move
        motion = move.at(times_s)
        return reference.seen_from(target, *motion) if isinstance(move, Escape) else motion

    def _attitudes(self, i: int, offsets: Array, times_s: Array) -> Array:
        """Return reference attitudes, body to TRF, at offsets (K, 3) and times (K,): (K, 4), or
        (4,) if constant.
        """
        c, q = self._scenario.chasers[i], np.array(self._scenario.chasers[i].q_wxyz)
        if self._scenario.approach.face_target or self._machine.chasers[i].faces:
            q = facing_attitudes(c.position_m, c.q_wxyz, offsets)
        turns = self._machine.body_rotations(i, times_s)
        return q if turns is None else rotations.multiply(q, turns)

    def _margins_m(self, covariances: Sequence[Array]) -> Array:
        """Return the additions (N,) to the distance from the target for uncertain positions, the
        first blocks of ``covariances``.
        """
        sigmas_m = np.sqrt(np.linalg.eigvalsh(np.array([c[:3, :3] for c in covariances]))[:, -1])
        return np.minimum(
            self._scenario.limits.estimate_margin_sigmas * sigmas_m, _GREATEST_MARGIN_M
        )
