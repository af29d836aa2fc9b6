# SPDX-License-Identifier: Apache-2.0
"""Seeded detumbling flights that begin with latched chasers, and what a frozen attitude would need
at the least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_agents.chaser.command_gate import damping_command
from chaserdock_agents.chaser.local_damping import LocalDamping
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.guidance.chaser_state import ChaserGuidance
from chaserdock_controller.guidance.detumble.allocation import MinimumTime, minimum_time
from chaserdock_controller.guidance.detumble.stack import StackMotion, thruster_wrenches
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.trajectories import stay
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.mounting import MountedChaser
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
from .latched_stack import (
    attach_plants,
    body_of_plant,
    moving_with,
    stack_motion,
    with_port_error,
)

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
            self._damping = {i: LocalDamping(flight, i) for i in self.chasers}
        target = self.physics.state(TARGET)
        for i in self.chasers:
            own = with_port_error(scenario, i, nominal_mounting(scenario, i))
            place = own.position_m
            self.physics.place(f"chaser/{i}", moving_with(target, place, own.q_wxyz))
            self.physics.close_latch(i)
            verified = ChaserGuidance(Phase.VERIFIED, 0.0, stay(place, 0.0))
            self.controller.guidance.chasers[i].state = verified

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
            thrusters = self.cores[i].thrusters
            assert thrusters is not None
            commands[i] = thrusters.add_pulses(command, thrusts_N)
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
    """One flight from the command to stop on.

    ``time_s`` until the stack stays below the limits (None: it does not); ``impulse_N_s`` of all
    thrusters until then, and ``held_N_s`` from then to the end, ``held_s`` long. ``least``: with a
    frozen attitude, at the command. ``peak_*``: largest loads at a port in any physics step.
    ``failed``: thrusters found and isolated. Errors of the identified target, if a controller
    identified it: mass (share), centre (m), worst inertia (share of the largest moment); ``nees``
    per degree of freedom of the stack's mass properties.
    """

    seed: int
    rate_deg_s: float
    refused: str
    time_s: float | None
    impulse_N_s: float
    held_N_s: float
    held_s: float
    least: MinimumTime | None
    final_rate_deg_s: float
    final_speed_m_s: float
    peak_force_N: float
    peak_torque_N_m: float
    failed: str = ""
    mass_share: float | None = None
    centre_m: float | None = None
    inertia_share: float | None = None
    nees: float | None = None

    def line(self) -> str:
        """Return one line for people."""
        if self.refused:
            return f"{self.rate_deg_s:.1f} degrees/s, refused: {self.refused}"
        text = "not stopped" if self.time_s is None else f"{self.time_s:.2f} s"
        text = f"{self.rate_deg_s:.1f} degrees/s, {text}, {self.impulse_N_s:.1f} N s"
        if self.least is not None:
            text += f"; LP {self.least.time_s:.2f} s, {self.least.impulse_N_s:.1f} N s"
        return f"{text}; {self.failed}" if self.failed else text


class DetumbleLog:
    """What the outcome of a flight needs of each of its ticks."""

    def __init__(self, limits: RestLimits, period_s: float) -> None:
        self._limits, self._period_s = limits, period_s
        self._impulses_N_s: list[float] = []
        self._peaks = np.zeros(2)
        self._rest_ticks = 0
        self._rates = 0.0, 0.0

    def add(self, impulse_N_s: float, rates: tuple[float, float], *loads: Sequence[float]) -> None:
        """Take a tick: the impulse of all thrusters, the speed (m/s) and rate (rad/s) after it, and
        force (N) and torque (N m) at ports.
        """
        self._impulses_N_s.append(impulse_N_s)
        self._rates = rates
        speed_m_s, rate_deg_s = rates[0], math.degrees(rates[1])
        rests = speed_m_s < self._limits.speed_m_s and rate_deg_s < self._limits.rate_deg_s
        self._rest_ticks = self._rest_ticks + 1 if rests else 0
        for load in loads:
            self._peaks = np.maximum(self._peaks, load)

    @property
    def at_rest_s(self) -> float:
        """Return for how long the stack has been at rest."""
        return self._rest_ticks * self._period_s

    def figures(self) -> dict[str, Any]:
        """Return the fields of the outcome."""
        since = len(self._impulses_N_s) - self._rest_ticks
        return {
            "time_s": since * self._period_s if self._rest_ticks else None,
            "impulse_N_s": float(sum(self._impulses_N_s[:since])),
            "held_N_s": float(sum(self._impulses_N_s[since:])),
            "held_s": self.at_rest_s,
            "final_speed_m_s": self._rates[0],
            "final_rate_deg_s": math.degrees(self._rates[1]),
            "peak_force_N": float(self._peaks[0]),
            "peak_torque_N_m": float(self._peaks[1]),
        }


def fly_stack(
    scenario: Scenario,
    perception_of: Callable[[Scenario], PerceptionModel],
    duration_s: float = 30.0,
) -> DetumbleOutcome:
    """Fly a stack in the physics engine from ``COMMAND_AT_S`` on for ``duration_s``."""
    log = DetumbleLog(scenario.detumble, 1.0 / scenario.time.rate_hz)
    with StackMission(scenario, perception_of(scenario)) as mission:
        while mission.time_s < COMMAND_AT_S:
            mission.step()
        body, mounted, motion = mission.truth(mission.states())
        least = least_time(scenario, body, mounted, motion)
        commands = tuple(OperatorCommand(command="detumble", chaser=i) for i in mission.chasers)
        record = mission.step(commands)
        replies = [] if record.outputs is None else record.outputs.replies
        refused = next((reply.reason for reply in replies if not reply.accepted), "")
        while not refused and mission.time_s < COMMAND_AT_S + duration_s:
            rates = mission.truth(mission.states())[2].rates(body)
            log.add(_impulse(record), rates, *_peaks(record))
            record = mission.step()
        log.add(_impulse(record), mission.truth(mission.states())[2].rates(body), *_peaks(record))
    return DetumbleOutcome(
        seed=scenario.seed,
        rate_deg_s=math.degrees(motion.rates(body)[1]),
        refused=refused,
        least=least,
        **log.figures(),
    )


def _peaks(record: TickRecord) -> list[tuple[float, float]]:
    """Return the largest force (N) and torque (N m) at each port since the tick before."""
    return [(load.peak_force_N, load.peak_torque_N_m) for load in record.loads.values()]
