# SPDX-License-Identifier: Apache-2.0
"""References of the chasers, now and over the NMPC horizon."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.plane import flattened
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.shape_distance import box_table, moved
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.planar import height_m, up_in_target
from chaserdock_protocol.scenario.schema import MAX_ESTIMATE_MARGIN_M

from chaserdock_controller.bodies.target_body import TargetBody, TargetPath, predict_path
from chaserdock_controller.interfaces import HorizonReference, RelativePose, TargetState

from . import reference
from .approach_cone import corridor_rows
from .chaser_machine import ChaserMachine
from .phases import DOCKING
from .pointing import calibration_turns
from .trajectories import Escape


def target_path(
    body: TargetBody,
    torque_free: bool,
    start: TargetState | BodyState,
    step_s: float,
    steps: int,
) -> TargetPath:
    """Return the target's predicted motion at 0, step_s, ... steps * step_s, followed by that at
    the midpoints.
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
    """Computes the references of chasers from their moves and phases."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self._step_s = scenario.controller.dt_s
        self._stages = round(scenario.controller.horizon_s / scenario.controller.dt_s)
        self._up = up_in_target(scenario)
        if self._up is not None:
            chasers = range(len(scenario.chasers))
            self._heights_m = [height_m(scenario, i, self._up) for i in chasers]
        keeps = scenario.limits.min_distance_shape_m > 0.0
        self._boxes = box_table(scenario.target_model().boxes) if keeps else None

    def pose(
        self, chaser: ChaserMachine, target: TargetState, now_s: float
    ) -> tuple[Array, Array, Array]:
        """Return a chaser's present reference: position (3,) and attitude (4,) in WRF, offset (3,)
        in TRF.
        """
        move = chaser.state.move
        offset = move.at(np.array([now_s]))[0][0]
        if isinstance(move, Escape):
            offset = rotations.rotate_inverse(target.q_wxyz, offset)
        if self._up is not None:
            offset = flattened(offset, self._up, self._heights_m[chaser.number])
        position = target.position_m + rotations.rotate(target.q_wxyz, offset)
        q_off = self._attitudes(chaser, offset[None], np.array([now_s])).reshape(4)
        return position, rotations.multiply(target.q_wxyz, q_off), offset

    def horizon(
        self,
        chasers: Sequence[ChaserMachine],
        start: TargetState,
        body: TargetBody,
        attached: frozenset[int],
        relative: Sequence[RelativePose | None],
    ) -> HorizonReference:
        """Return the references of ``chasers`` from the time of ``start`` on.

        ``relative``: their poses relative to the target, None where not estimated; their covariance
        widens the distance to keep from the target.
        """
        s, step_s = self._scenario, self._step_s
        torque_free = s.target.motion == "torque_free"
        path, k = target_path(body, torque_free, start, step_s, self._stages), self._stages + 1
        nodes, middles = path.at(slice(k)), path.at(slice(k, None))

        # References at the nodes and, for the feed-forward, at the middles of the stages.
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

        margins = self._margins_m(
            [start.covariance if r is None else r.covariance for r in relative]
        )
        distances = np.array([c.min_distance_target_m() for c in chasers])
        # An uncertain pose must not push a chaser out of its port's corridor: no other place is
        # safe there.
        room = [
            length(r.position_m) - d if r is not None and c.in_corridor() else np.inf
            for c, r, d in zip(chasers, relative, distances.tolist(), strict=True)
        ]
        distances = distances + np.minimum(margins, np.maximum(room, 0.0))

        boxes = clearance = None
        if self._boxes is not None:
            boxes = moved(self._boxes, nodes.positions_m, nodes.q_wxyz)
            kept = np.array([c.min_distance_shape_m() for c in chasers])
            clearance = np.where(kept > 0.0, kept + margins, 0.0)

        return HorizonReference(
            chasers=tuple(c.number for c in chasers),
            references=reference.references_on(
                nodes.positions_m, nodes.q_wxyz, positions[:, :k], q_off[:, :k]
            ),
            u_ref=u_ref,
            target_positions=nodes.positions_m,
            min_distance_target_m=distances,
            corridors=corridor_rows([c.corridor() for c in chasers], nodes.q_wxyz),
            attached=attached,
            boxes=boxes,
            box_clearance_m=clearance,
            docking=tuple(row for row, c in enumerate(chasers) if c.phase in DOCKING),
        )

    def _offsets(
        self, chasers: Sequence[ChaserMachine], times_s: Array, target: TargetPath
    ) -> tuple[tuple[Array, Array, Array], Array]:
        """Return the offsets of chasers at times (K,) at which the target moves as ``target``.

        Offsets, velocities and accelerations in TRF, each (N, K, 3); attitudes, body to TRF, (N, K,
        4).
        """
        moves = [self._motion(c, times_s, target) for c in chasers]
        q_off = np.empty((len(chasers), len(times_s), 4))
        for row, c in enumerate(chasers):
            q_off[row] = rotations.normalize(self._attitudes(c, moves[row][0], times_s))
        positions, velocities, accelerations = (np.array(part) for part in zip(*moves, strict=True))
        return (positions, velocities, accelerations), q_off

    def _motion(
        self, chaser: ChaserMachine, times_s: Array, target: TargetPath
    ) -> tuple[Array, Array, Array]:
        """Return a chaser's offsets, velocities and accelerations (K, 3) in TRF at times (K,); in
        the plane of the floor, if there is one.
        """
        move, up = chaser.state.move, self._up
        motion = move.at(times_s)
        if isinstance(move, Escape):
            motion = reference.seen_from(target, *motion)
        if up is None:
            return motion
        position, velocity, acceleration = motion
        level = flattened(position, up, self._heights_m[chaser.number])
        return level, flattened(velocity, up), flattened(acceleration, up)

    def _attitudes(self, chaser: ChaserMachine, offsets: Array, times_s: Array) -> Array:
        """Return reference attitudes, body to TRF, at offsets (K, 3) and times (K,): (K, 4), or
        (4,) if constant.
        """
        c, state = self._scenario.chasers[chaser.number], chaser.state
        q = np.array(c.q_wxyz)
        if self._scenario.approach.face_target or state.faces:
            away = offsets - chaser.line.base_m
            q = facing_attitudes(c.position_m, c.q_wxyz, away, self._up)
        if state.turns:
            q = rotations.multiply(q, calibration_turns(times_s - state.since_s))
        if state.slew is None or state.slew.over_at(float(times_s[0])):
            return q
        return rotations.multiply(q, state.slew.at(times_s))

    def _margins_m(self, covariances: Sequence[Array]) -> Array:
        """Return the distances (N,), m, added to the keep-out for uncertain positions, the first
        blocks of ``covariances``.
        """
        sigmas_m = np.sqrt(np.linalg.eigvalsh(np.array([c[:3, :3] for c in covariances]))[:, -1])
        return np.minimum(
            self._scenario.limits.estimate_margin_sigmas * sigmas_m, MAX_ESTIMATE_MARGIN_M
        )
