# SPDX-License-Identifier: Apache-2.0
"""Seeded detumbling flights that begin with latched chasers, and what a frozen attitude would need
at the least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_agents.chaser.command_gate import damping_command
from chaserdock_agents.chaser.local_damping import LocalDamping
from chaserdock_controller.estimation.target_body import TargetBody
from chaserdock_controller.guidance.chaser_state import ChaserGuidance
from chaserdock_controller.guidance.detumble.allocation import MinimumTime, minimum_time
from chaserdock_controller.guidance.detumble.stack import StackMotion, thruster_wrenches
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.trajectories import stay
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import ActuatorCommand, Odometry, OperatorCommand
from chaserdock_protocol.scenario import Scenario, flight_scenario
from chaserdock_protocol.scenario.detumble import RestLimits
from chaserdock_protocol.scenario.mission import Success
from chaserdock_protocol.scenario.mounting import nominal_mounting, plume_free_thrusters
from chaserdock_protocol.scenario.thrusters import thrusts_max
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States

from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import PerceptionModel

from . import load_shipped
from .latched_stack import attach_plants, body_of_plant, stack_motion, with_port_error

COMMAND_AT_S = 5.0
"""Until then the estimator settles."""


def stack_scenario(seed: int, chasers: Sequence[int], changes: Sequence[str] = ()) -> Scenario:
    """Return ``detumble`` with these of its chasers, renumbered, and a tumble of 5 to 10 degrees/s
    drawn from the seed.

    ``changes`` as of ``run --set``.
    """
    scenario = load_shipped(
        "detumble", f"seed={seed}", "timeline=[]", "perception.name=statistical", *changes
    )
    rng = np.random.default_rng([seed, 0xDE7])
    ports = [
        scenario.docking.port_of(old).model_copy(update={"chaser": new})  # type: ignore[union-attr]
        for new, old in enumerate(chasers)
    ]
    target = scenario.target.model_copy(
        update={
            "q_wxyz": tuple(rotations.normalize(rng.normal(size=4)).tolist()),
            "omega_rad_s": tuple(_random_vector(rng, math.radians(rng.uniform(5.0, 10.0)))),
            "velocity_m_s": tuple(_random_vector(rng, 0.034)),
        }
    )
    return scenario.model_copy(
        update={
            "target": target,
            "docking": scenario.docking.model_copy(update={"ports": tuple(ports)}),
            "chasers": tuple(scenario.chasers[i] for i in chasers),
            "success": Success(),
        }
    )


def with_load_limits(scenario: Scenario, force_N: float, torque_N_m: float) -> Scenario:
    """Return a scenario with these load limits at every port."""
    limits = {"force_limit_N": force_N, "torque_limit_N_m": torque_N_m}
    ports = tuple(port.model_copy(update=limits) for port in scenario.docking.ports)
    return scenario.model_copy(
        update={"docking": scenario.docking.model_copy(update={"ports": ports})}
    )


def _random_vector(rng: np.random.Generator, length: float) -> list[float]:
    direction = rng.normal(size=3)
    return (length * direction / np.linalg.norm(direction)).tolist()


class StackMission(InProcessMission):
    """A mission that begins with all chasers latched, with seeded errors at their ports, and
    verified.

    ``silent_from_s``: from then on there is no controller, and each chaser damps the stack by
    itself.
    """

    def __init__(
        self, scenario: Scenario, perception: PerceptionModel, silent_from_s: float = math.inf
    ) -> None:
        super().__init__(scenario, perception)
        self._silent_from_s = silent_from_s
        self._damping: dict[int, LocalDamping] = {}
        if math.isfinite(silent_from_s):
            flight = flight_scenario(scenario)
            self._damping = {i: LocalDamping(flight, i) for i in self.thrusters}
        target = self.physics.state(TARGET)
        for i in self.chasers:
            own = with_port_error(scenario, i, nominal_mounting(scenario, i))
            place = own.position_m
            self.physics.place(f"chaser/{i}", moving_with(target, place, own.q_wxyz))
            self.physics.close_latch(i)
            verified = ChaserGuidance(Phase.VERIFIED, 0.0, stay(place, 0.0))
            self.controller.guidance.machine.chasers[i] = verified

    def _control(self, inputs: TickInputs) -> TickOutputs | None:
        return None if inputs.time_ns / 1e9 >= self._silent_from_s else super()._control(inputs)

    def uncommanded(
        self, odometry: Mapping[int, Odometry], time_ns: int
    ) -> dict[int, ActuatorCommand]:
        """Return the commands of latched chasers that damp the stack, each by itself."""
        effective_ns = self.scenario.timing.effective_ns(self.tick)
        commands = {}
        for i, damping in self._damping.items():
            command, thrusts_N = damping_command(
                damping, odometry[i], effective_ns, self.scenario.chaser
            )
            commands[i] = self.thrusters[i].add_pulses(command, thrusts_N)
        return commands

    def truth(self, states: States) -> tuple[TargetBody, dict[int, MountedChaser], StackMotion]:
        """Return the true stack, where its chasers are, and its momentum in TRF axes."""
        target = states[TARGET]
        mounted = {}
        for i in self.chasers:
            own = states[f"chaser/{i}"]
            place = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
            q = rotations.multiply(rotations.conjugate(target.q_wxyz), own.q_wxyz)
            mounted[i] = MountedChaser(place, q)
        body = self.true_body(mounted)
        return (
            body,
            mounted,
            stack_motion(body, target.velocity_m_s, target.q_wxyz, target.omega_rad_s),
        )

    def true_body(self, mounted: dict[int, MountedChaser]) -> TargetBody:
        """Return the true mass properties of the target with the mounted chasers."""
        plants = self.physics.plants
        chasers = {i: plants[f"chaser/{i}"] for i in mounted}
        return attach_plants(body_of_plant(plants[TARGET]), chasers, mounted)


def moving_with(target: BodyState, place_m: Array, q_wxyz: Array) -> BodyState:
    """Return the state of a body fixed to the target at a place (3,) and attitude (4,) in TRF."""
    arm = rotations.rotate(target.q_wxyz, place_m)
    omega_world = rotations.rotate(target.q_wxyz, target.omega_rad_s)
    return BodyState(
        target.position_m + arm,
        target.velocity_m_s + np.cross(omega_world, arm),
        rotations.multiply(target.q_wxyz, q_wxyz),
        rotations.rotate_inverse(q_wxyz, target.omega_rad_s),
    )


def _impulse(record: TickRecord) -> float:
    """Return the impulse of all thrusters in a tick, N s."""
    return sum(sum(output.thruster_impulse_N_s) for output in record.delivered.values())


def least_time(
    scenario: Scenario, body: TargetBody, mounted: dict[int, MountedChaser], motion: StackMotion
) -> MinimumTime | None:
    """Return the shortest time in which the plume-free thrusters stop a stack whose attitude is
    frozen, and its impulse.
    """
    thrusters = scenario.chaser.thrusters
    free = np.concatenate([*plume_free_thrusters(scenario, mounted.keys()).values()])
    limits = np.where(free, np.tile(thrusts_max(thrusters), len(mounted)), 0.0)
    return minimum_time(thruster_wrenches(body, mounted, thrusters), motion.momentum, limits)


@dataclass(frozen=True)
class DetumbleOutcome:
    """One flight. ``time_s`` from the command until the stack stays below the limits, None if it
    does not; ``impulse_N_s`` of all thrusters until then, and ``held_N_s`` from then to the end,
    ``held_s`` long. ``least``: at the command. ``peak_*``: largest loads at a port in any physics
    step after the command."""

    seed: int
    chasers: int
    rate_deg_s: float
    refused: str
    time_s: float | None
    impulse_N_s: float
    held_N_s: float
    held_s: float
    least: MinimumTime | None
    final_rate_deg_s: float
    final_speed_m_s: float
    peak_force_N: float | None = None
    peak_torque_N_m: float | None = None


def fly_stack(
    scenario: Scenario,
    perception_of: Callable[[Scenario], PerceptionModel],
    duration_s: float = 30.0,
    limits: RestLimits | None = None,
    silent_after_s: float = math.inf,
) -> DetumbleOutcome:
    """Fly a stack from ``COMMAND_AT_S`` on for ``duration_s``; ``limits``: of rest, without any the
    scenario's.

    ``silent_after_s`` after the command the controller falls silent.
    """
    limits = limits or scenario.detumble
    with StackMission(scenario, perception_of(scenario), COMMAND_AT_S + silent_after_s) as mission:
        while mission.time_s < COMMAND_AT_S:
            mission.step()
        states = mission.states()
        body, mounted, motion = mission.truth(states)
        least = least_time(scenario, body, mounted, motion)
        rate_deg_s = math.degrees(motion.rates(body)[1])
        commands = tuple(OperatorCommand(command="detumble", chaser=i) for i in mission.chasers)
        first = mission.step(commands)
        replies = [] if first.outputs is None else first.outputs.replies
        refused = next((reply.reason for reply in replies if not reply.accepted), "")
        impulses, inside, peaks = [_impulse(first)], [False], np.zeros(2)
        while not refused and mission.time_s < COMMAND_AT_S + duration_s:
            record = mission.step()
            impulses.append(_impulse(record))
            for load in record.loads.values():
                peaks = np.maximum(peaks, [load.peak_force_N, load.peak_torque_N_m])
            speed, rate = mission.truth(record.states)[2].rates(body)
            inside.append(speed < limits.speed_m_s and math.degrees(rate) < limits.rate_deg_s)
        speed, rate = mission.truth(mission.states())[2].rates(body)
    since = len(inside) - next((k for k, x in enumerate(reversed(inside)) if not x), len(inside))
    stopped, period_s = since < len(inside), 1.0 / scenario.time.rate_hz
    return DetumbleOutcome(
        seed=scenario.seed,
        chasers=len(scenario.chasers),
        rate_deg_s=rate_deg_s,
        refused=refused,
        time_s=since * period_s if stopped else None,
        impulse_N_s=float(sum(impulses[:since])),
        held_N_s=float(sum(impulses[since:])),
        held_s=(len(inside) - since) * period_s,
        least=least,
        final_rate_deg_s=math.degrees(rate),
        final_speed_m_s=speed,
        peak_force_N=float(peaks[0]),
        peak_torque_N_m=float(peaks[1]),
    )
