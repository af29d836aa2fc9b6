# SPDX-License-Identifier: Apache-2.0
"""A stack of target and latched chasers as one rigid body.

Joints, contacts and images of the physics engine are left out. Thrusters and sensors are those of
the simulator; ``tests/chaserdock/test_silent_controller.py`` compares both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from chaserdock_agents.chaser.local_damping import LocalDamping
from chaserdock_agents.chaser.thrusters.modulation import Modulator
from chaserdock_controller.guidance.detumble.port_loads import load_model
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState, free_rotation
from chaserdock_models.thruster_model import Valves
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry, ThrusterPulse
from chaserdock_protocol.scenario import Scenario, flight_scenario
from chaserdock_protocol.scenario.mounting import nominal_mounting
from chaserdock_protocol.scenario.thrusters import thrusts_max
from chaserdock_world.actuators.thrusters import true_thrusters
from chaserdock_world.plant import actuation_errors, chaser_plant, target_plant
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import odometry_of

from .latched_stack import attach_plants, body_of_plant, with_port_error

_SUBSTEPS = 4
"""Steps of the free rotation per tick, each with half of the impulse before and after it."""
_LOAD_HZ = 960
"""Rate of the loads at the ports: that of the physics engine."""


@dataclass(frozen=True, eq=False)
class StackStep:
    """One tick of a stack: impulse of all thrusters (N s), and by chaser the impulses (n,) that its
    thrusters should have given, and the impulse (6,), body axes, that they should give until the
    next command acts; the largest force and torque at any port."""

    used_N_s: float
    stated_N_s: Mapping[int, Array]
    coming: Mapping[int, Array]
    peak_force_N: float
    peak_torque_N_m: float


class RigidStack:
    """All chasers of a scenario at their ports, with its true bodies and thrusters, and the
    target's start state.

    One ``step`` per tick. ``port_errors``: whether the chasers are latched with seeded errors of a
    few millimetres.
    """

    def __init__(self, scenario: Scenario, port_errors: bool = False) -> None:
        self.scenario = scenario
        flight, target = flight_scenario(scenario), scenario.target
        self.mounted = {i: nominal_mounting(flight, i) for i in range(len(scenario.chasers))}
        if port_errors:
            self.mounted = {i: with_port_error(scenario, i, c) for i, c in self.mounted.items()}
        self.target = body_of_plant(target_plant(scenario))
        plants = {i: chaser_plant(scenario, i) for i in self.mounted}
        self.body = attach_plants(self.target, plants, self.mounted)
        self.q_wxyz = np.array(target.q_wxyz)
        self.omega_rad_s = np.array(target.omega_rad_s)
        arm = rotations.rotate(
            self.q_wxyz, rotations.cross(self.omega_rad_s, self.body.centre_trf_m)
        )
        self.velocity_m_s = np.array(target.velocity_m_s) + arm
        self.centre_m = rotations.rotate(self.q_wxyz, self.body.centre_trf_m)
        self.tick = 0
        self._flight = flight
        self._damping: dict[int, LocalDamping] = {}
        thrusters = scenario.chaser.thrusters
        self._full_N, self._own = thrusts_max(thrusters), wrench_matrix(thrusters)
        self._modulators = {
            i: Modulator(thrusters, scenario.chaser.modulation, scenario.timing)
            for i in self.mounted
        }
        self._errors = {i: actuation_errors(scenario, i) for i in self.mounted}
        self._valves, self._stated_valves = {}, {i: Valves(thrusters) for i in self.mounted}
        self._wrenches, self._true_own = {}, {}
        self._load_steps = _SUBSTEPS * round(_LOAD_HZ / (_SUBSTEPS * scenario.time.rate_hz))
        self._tips_m = {port.chaser: np.array(port.position_m) for port in scenario.docking.ports}
        for i, chaser in self.mounted.items():
            true = true_thrusters(thrusters, self._errors[i])
            self._valves[i] = Valves(true)
            for failure in (f for f in scenario.thruster_failure if f.chaser == i):
                self._valves[i].fail(
                    failure.thruster, failure.kind, round(failure.at_s * 1e9), failure.factor
                )
            self._true_own[i] = wrench_matrix(true)
            self._wrenches[i] = chaser.wrench_to_stack(self._true_own[i], self.body.centre_trf_m)
        self._shortest_ns = [round(t.min_on_s * 1e9) for t in thrusters]
        self._sensor = OdometrySensor(scenario)

    def rates(self) -> tuple[float, float]:
        """Return the speed of the centre of mass (m/s) and the angular rate (rad/s)."""
        return float(np.linalg.norm(self.velocity_m_s)), float(np.linalg.norm(self.omega_rad_s))

    def state(self, chaser: int) -> BodyState:
        """Return the true state of a chaser."""
        mounted = self.mounted[chaser]
        arm = mounted.position_m - self.body.centre_trf_m
        return BodyState(
            self.centre_m + rotations.rotate(self.q_wxyz, arm),
            self.velocity_m_s
            + rotations.rotate(self.q_wxyz, rotations.cross(self.omega_rad_s, arm)),
            rotations.multiply(self.q_wxyz, mounted.q_wxyz),
            rotations.rotate_inverse(mounted.q_wxyz, self.omega_rad_s),
        )

    def measure(self, chaser: int) -> Odometry:
        """Return the odometry of a chaser now."""
        time_ns = self.scenario.timing.tick_time_ns(self.tick)
        return odometry_of(self._sensor, chaser, self.state(chaser), self.tick, time_ns)

    def damping(self) -> dict[int, Array]:
        """Return the thrusts (n,) with which every chaser damps the stack by its own odometry."""
        if not self._damping:
            self._damping = {i: LocalDamping(self._flight, i) for i in self.mounted}
        return {i: damping.thrusts_N(self.measure(i)) for i, damping in self._damping.items()}

    def step(
        self, thrusts_N: Mapping[int, Array], shut: Mapping[int, tuple[int, ...]] | None = None
    ) -> StackStep:
        """Fly one tick with commanded thrusts (n,) by chaser; ``shut``: thrusters whose shut-off
        valve is closed.
        """
        timing = self.scenario.timing
        begin_ns, end_ns = timing.tick_time_ns(self.tick), timing.tick_time_ns(self.tick + 1)
        fine = self._load_steps
        edges_ns = np.linspace(begin_ns, end_ns, fine + 1).astype(int)
        impulses = np.zeros((_SUBSTEPS, 6))
        opened = {}
        used_N_s, stated, coming = 0.0, {}, {}
        next_ns = timing.effective_ns(self.tick + 1)
        for i, modulator in self._modulators.items():
            if i in thrusts_N:
                span_ns = timing.effective_ns(self.tick), next_ns
                for valves in (self._valves[i], self._stated_valves[i]):
                    valves.set_shut((shut or {}).get(i, ()), span_ns[0])
                for p in modulator.pulses(thrusts_N[i], self._full_N, *span_ns):
                    close_ns = p.open_ns + self._width_ns(i, p)
                    self._valves[i].pulse(p.thruster, p.open_ns, close_ns)
                    self._stated_valves[i].pulse(p.thruster, p.open_ns, p.close_ns)
            given = self._valves[i].impulses(edges_ns)
            ahead = self._stated_valves[i].impulses(np.array([end_ns, next_ns + 1_000_000_000]))[0]
            coming[i] = self._own @ (ahead - modulator.advance_N_s(next_ns))
            stated[i] = self._stated_valves[i].impulses(edges_ns[[0, -1]])[0]
            for valves in (self._valves[i], self._stated_valves[i]):
                valves.forget_before(begin_ns)
            opened[i] = given
            impulses += (
                given.reshape(_SUBSTEPS, -1, given.shape[1]).sum(axis=1) @ self._wrenches[i].T
            )
            used_N_s += float(given.sum())
        peaks = self._peak_loads(opened, (end_ns - begin_ns) * 1e-9 / fine)
        for impulse in impulses:
            self._advance(impulse, (end_ns - begin_ns) * 1e-9 / _SUBSTEPS)
        self.tick += 1
        return StackStep(used_N_s, stated, coming, *peaks)

    def _peak_loads(self, given_N_s: Mapping[int, Array], step_s: float) -> tuple[float, float]:
        """Return the largest force (N) and torque about the tip (N m) at any port under impulses
        (K, n) of every chaser's thrusters in K steps; the mass and inertia of the chasers are the
        scenario's."""
        count = len(self._full_N)
        own = {
            i: (slice(k * count, (k + 1) * count), self._true_own[i])
            for k, i in enumerate(self.mounted)
        }
        wrenches = np.concatenate([self._wrenches[i] for i in self.mounted], axis=1)
        chaser = self.scenario.chaser
        model = load_model(
            self.body, self.omega_rad_s, wrenches, self.mounted, own, chaser, self._tips_m, {}
        )
        thrusts = np.concatenate([given_N_s[i] for i in self.mounted], axis=1) / step_s
        loads = model.constant[:, :, None] + model.by_thrust @ thrusts.T
        return (
            float(np.linalg.norm(loads[:, :3], axis=1).max()),
            float(np.linalg.norm(loads[:, 3:], axis=1).max()),
        )

    def _width_ns(self, chaser: int, pulse: ThrusterPulse) -> int:
        """Return how long a pulse opens its valve: as commanded, up to scatter, but not below the
        minimum on-time.
        """
        errors, width = self._errors[chaser], pulse.close_ns - pulse.open_ns
        if not errors.scatter_share:
            return width
        scattered = round(width * float(errors.scatter(pulse.thruster, pulse.open_ns, 1)[0]))
        return max(scattered, min(width, self._shortest_ns[pulse.thruster]))

    def _advance(self, impulse: Array, step_s: float) -> None:
        """Advance by ``step_s`` with an impulse (6,), TRF axes, half of it before and half after a
        free rotation.
        """
        turn = np.linalg.solve(self.body.inertia_kg_m2, impulse[3:]) / 2.0
        self.velocity_m_s = (
            self.velocity_m_s + rotations.rotate(self.q_wxyz, impulse[:3]) / self.body.mass_kg
        )
        self.centre_m = self.centre_m + step_s * self.velocity_m_s
        qs, omegas, _ = free_rotation(
            self.q_wxyz, self.omega_rad_s + turn, self.body.inertia_kg_m2, step_s, 2
        )
        self.q_wxyz, self.omega_rad_s = qs[1], omegas[1] + turn
