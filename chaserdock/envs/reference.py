# SPDX-License-Identifier: Apache-2.0
"""The action ``reference``: offsets of the reference that the NMPC follows.

An action (6,) moves a chaser's reference by shares, -1 to 1, of ``[learning.reference]``: position
along the axes of TRF, and rotation vector in CRF. From the observation, with its errors, the back
end ``rti`` plans the wrench, one problem for all chasers of an environment, with the keep-out
distances and the corridor that missions have.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_controller.guidance import reference
from chaserdock_controller.guidance.approach_cone import cone_of, corridor_rows
from chaserdock_controller.guidance.horizon import target_path
from chaserdock_controller.nmpc import NmpcInput
from chaserdock_controller.nmpc.rti import RtiSolver
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.learning import LearningReference
from numpy.typing import NDArray

from ..analysis.criteria import nearest_allowed_m
from .observation import goal_of

_MARGIN_M = 0.02
"""Distance by which plans keep farther away than the limits at which an episode ends, m: the
distances of the NMPC are soft, and references that press against them violate them by millimetres.
"""


class ReferenceFlight:
    """Flies the chasers of ``environments`` by the NMPC. ``kind``: of ``TASKS`` (task.py)."""

    def __init__(
        self, scenario: Scenario, settings: LearningReference, kind: str, environments: int
    ) -> None:
        chasers = range(len(scenario.chasers))
        self._scenario, self._kind = scenario, kind
        self._goals = [goal_of(scenario, i, kind) for i in chasers]
        # The reference without an offset: the goal, and with `inspect` the place of the chaser.
        places = [goal_of(scenario, i, "hold" if kind == "inspect" else kind) for i in chasers]
        self._places_m = np.array([place.position_m for place in places])
        self._attitudes = np.array([place.q_wxyz for place in places])
        self._reach = settings.position_m, math.radians(settings.rotation_deg)
        docks = kind in ("come", "latch")
        self._cones = [cone_of(scenario, i) if docks else None for i in chasers]
        self._nearest_m = [nearest_allowed_m(scenario, i) if docks else 0.0 for i in chasers]
        self._parameters = nmpc_parameters(scenario)
        self._limits = np.tile(np.array(scenario.chaser.wrench_max), (len(chasers), 1))
        self._inertia = np.array(scenario.chaser.inertia)
        self._body: TargetBody = target_body(scenario)
        self._solvers = [RtiSolver(self._parameters, len(chasers)) for _ in range(environments)]
        self._last = np.zeros((environments, len(chasers), 6))

    def restart(self, environments: NDArray[np.bool_]) -> None:
        """Discard the plans of the environments (n,) that start anew."""
        self._last[environments] = 0.0
        for e in np.flatnonzero(environments).tolist():
            self._solvers[e].reset()

    def wrenches(self, observations: Array, actions: Array, flying: NDArray[np.bool_]) -> Array:
        """Return wrenches (n, m, 6) in shares of the limits, for observations (n, m, width) and
        actions (n, m, 6) of the environments that are ``flying`` (n,); zeros for the others, and
        NaN for those with an action that is not finite.
        """
        out, tick_s = np.zeros(actions.shape), 1.0 / self._scenario.time.rate_hz
        states, rates = self._predicted(observations, self._last)
        for e in np.flatnonzero(flying).tolist():
            if not np.isfinite(actions[e]).all():
                out[e], self._last[e] = np.nan, 0.0
                continue
            problem = self._problem(states[e], rates[e], np.clip(actions[e], -1.0, 1.0))
            wrench = self._solvers[e].solve(problem, tick_s).inputs[:, 0]
            out[e], self._last[e] = wrench / self._limits, wrench
        return out

    def _predicted(self, seen: Array, wrench: Array) -> tuple[Array, Array]:
        """Return the states (n, m, 13) at which the next wrenches act, and the rates (n, 3) of the
        targets.

        In an inertial frame that coincides with TRF at the time of the observation, and moves with
        its origin.
        """
        late_s, body = self._scenario.time.latency_s, self._scenario.chaser
        goals_m = np.array([goal.position_m for goal in self._goals])
        goals = np.array([goal.q_wxyz for goal in self._goals])
        rate = seen[..., 13:16].mean(axis=1, keepdims=True)
        position = seen[..., :3] + goals_m
        velocity = seen[..., 3:6] + rotations.cross(rate, position)
        q = rotations.normalize(rotations.multiply(goals, seen[..., 6:10]))
        omega = seen[..., 10:13] + rotations.rotate_inverse(q, rate)
        velocity = velocity + late_s / body.mass_kg * rotations.rotate(q, wrench[..., :3])
        gyroscopic = rotations.cross(omega, self._inertia * omega)
        omega = omega + late_s * (wrench[..., 3:] - gyroscopic) / self._inertia
        turned = rotations.normalize(rotations.multiply(q, rotations.exp(late_s * omega)))
        place = position + late_s * velocity
        return np.concatenate([place, velocity, turned, omega], axis=-1), rate[:, 0]

    def _problem(self, states: Array, rate: Array, action: Array) -> NmpcInput:
        scenario, p = self._scenario, self._parameters
        turn = rotations.exp(scenario.time.latency_s * rate)
        start = BodyState(np.zeros(3), np.zeros(3), turn, rate)
        moves_freely = scenario.target.motion == "torque_free"
        path = target_path(self._body, moves_freely, start, p.dt_s, p.stages)
        nodes, middles = path.at(slice(p.stages + 1)), path.at(slice(p.stages + 1, None))

        offsets = self._places_m + self._reach[0] * action[:, :3]
        attitudes = self._attitudes
        if self._kind == "inspect":
            faced = (
                facing_attitudes(place, q, offset[None])[0]
                for place, q, offset in zip(self._places_m, attitudes, offsets, strict=True)
            )
            attitudes = np.array(list(faced))
        attitudes = rotations.multiply(attitudes, rotations.exp(self._reach[1] * action[:, 3:]))

        stages = (len(offsets), p.stages, 3)
        held, q_off = np.broadcast_to(offsets[:, None], stages), attitudes[:, None]
        u_ref = np.zeros((len(offsets), p.stages, 6))
        if scenario.controller.feed_forward:
            zeros, body = np.zeros(stages), scenario.chaser
            u_ref = reference.feed_forward(
                middles.omega_rad_s, held, zeros, zeros, np.broadcast_to(q_off, (*stages[:2], 4)),
                body.mass_kg, np.diag(body.inertia), middles.alpha_rad_s2,
                middles.acceleration_m_s2,
            )  # fmt: skip
        references = reference.references_on(
            nodes.positions_m,
            nodes.q_wxyz,
            np.broadcast_to(offsets[:, None], (len(offsets), p.stages + 1, 3)),
            np.broadcast_to(q_off, (len(offsets), p.stages + 1, 4)),
        )
        seen = rotations.rotate_inverse(turn, states[:, :3])
        inside = [
            cone is not None and cone.room_m(place) >= 0.0
            for cone, place in zip(self._cones, seen, strict=True)
        ]
        limits = scenario.limits
        outside_m = limits.min_distance_target_m + _MARGIN_M
        return NmpcInput(
            states=states,
            references=references,
            u_ref=u_ref,
            target_positions=nodes.positions_m,
            min_distance_target_m=np.where(inside, self._nearest_m, outside_m),
            min_distance_chasers_m=limits.min_distance_chasers_m + _MARGIN_M,
            input_max=self._limits,
            corridors=corridor_rows(
                [
                    cone if within else None
                    for cone, within in zip(self._cones, inside, strict=True)
                ],
                nodes.q_wxyz,
            ),
        )
