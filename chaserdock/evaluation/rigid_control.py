# SPDX-License-Identifier: Apache-2.0
"""The controller's identification and detumbling in closed loop with a rigid stack: fast, for statistics over many tumbles.

Odometry, thrusters and their errors are those of the simulator. The physics engine and the images are left out: the pose of the
target, by which the places of the chasers are first known, has a constant error drawn with ``_POSE_M`` and ``_POSE_RAD``.
``detumble_flights.fly_stack`` flies the same with both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from chaserdock_controller.estimation.identification.stage import StackIdentification
from chaserdock_controller.estimation.mass_properties import properties_of
from chaserdock_controller.estimation.types import TargetState
from chaserdock_controller.guidance.detumble.allocation import MinimumTime
from chaserdock_controller.guidance.detumble.control import DetumbleControl, StackState, StackTask
from chaserdock_controller.guidance.detumble.stack import StackMotion
from chaserdock_controller.interfaces import Observation, TargetEstimation
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import Scenario, flight_scenario

from .detumble_flights import least_time
from .rigid_stack import RigidStack

_POSE_M, _POSE_RAD = 0.001, math.radians(0.1)


@dataclass(frozen=True)
class StackFlight:
    """One flight. ``time_s`` until the stack stays below the limits (None: it does not), ``impulse_N_s`` until then, and
    ``held_N_s`` from then to the end. ``least``: with a frozen attitude. Errors of the identified target: mass (share), centre (m),
    worst inertia (share of the largest moment); ``nees`` per degree of freedom of the stack's mass properties."""

    seed: int
    rate_deg_s: float
    refused: str
    time_s: float | None
    impulse_N_s: float
    held_N_s: float
    least: MinimumTime | None
    final_rate_deg_s: float
    final_speed_m_s: float
    mass_share: float
    centre_m: float
    inertia_share: float
    nees: float
    failed: str


class ControlledStack:
    """A rigid stack and its controller, one ``step`` per tick. ``lost``: chasers that are dead: no odometry, no thrust."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.stack = scenario, RigidStack(scenario, port_errors=True)
        flight = flight_scenario(scenario)
        self.identification, self.control = StackIdentification(flight), DetumbleControl(flight)
        self.lost: frozenset[int] = frozenset()
        self.events: list[str] = []
        rng = np.random.default_rng([scenario.seed, 0x90E])
        self._pose_error = rng.normal(0.0, _POSE_M, 3), rng.normal(0.0, _POSE_RAD, 3)
        self._given: Mapping[int, Array] = {}
        self._coming: Mapping[int, Array] = {}

    def estimate(self) -> tuple[Observation, TargetEstimation]:
        """Return what the controller's first stages would find of the stack now."""
        stack, timing = self.stack, self.scenario.timing
        now_ns = timing.tick_time_ns(stack.tick)
        effective_ns = timing.effective_ns(stack.tick)
        odometry = {i: stack.measure(i) for i in stack.mounted if i not in self.lost}
        seconds = (effective_ns - now_ns) / 1e9
        observation = Observation(
            tick=stack.tick,
            time_ns=now_ns,
            effective_ns=effective_ns,
            odometry=odometry,
            invalid={},
            lost={},
            sightings=(),
            commands=(),
            docking={},
            impulses={},
            thruster_impulses={i: given for i, given in self._given.items() if i in odometry},
            ahead={i: ((1.0, self._coming[i]),) if i in self._coming and seconds else () for i in odometry},
            input_limits={},
            isolated={},
            events=(),
        )
        estimation = self._estimation(now_ns, odometry)
        return observation, self.identification.identified(observation, estimation)

    def _estimation(self, now_ns: int, odometry: Mapping[int, Odometry]) -> TargetEstimation:
        stack, (shift, turn) = self.stack, self._pose_error
        q = rotations.multiply(stack.q_wxyz, rotations.exp(turn))
        arm = rotations.rotate(stack.q_wxyz, stack.body.centre_trf_m - shift)
        position = stack.centre_m - arm
        velocity = stack.velocity_m_s - rotations.cross(
            rotations.rotate(stack.q_wxyz, stack.omega_rad_s), arm
        )
        target = TargetState(
            now_ns, position, velocity, q, stack.omega_rad_s, 1e-6 * np.eye(12), "tracking", len(odometry), ()
        )
        return TargetEstimation(
            target=target,
            at_effect=target,
            own=odometry,
            own_at_effect={},
            disturbances={},
            motion_covariances={},
            relative=(),
            visible_to=frozenset(odometry),
            cameras=(),
            latched=frozenset(stack.mounted),
            body=self.identification.target.body,
            events=(),
        )

    def step(self, task: StackTask | None, observation: Observation, estimation: TargetEstimation) -> float:
        """Fly one tick with a task of the thrusters, None for no thrust; return their impulse (N s)."""
        self.events += [text for _, text in estimation.events]
        commands: Mapping[int, Array] = {}
        state = self.control.state(observation, estimation)
        if task is not None and state is not None:
            isolated = {i: tuple(f) for i, f in self.identification.failed.items()}
            directs = self.control.commands(state, set(observation.odometry), isolated, task, observation)
            commands = {i: d.thrusts_N for i, d in directs.items() if d.thrusts_N is not None}
        shut = self.identification.failed
        flown = self.stack.step({i: commands.get(i, self._none()) for i in observation.odometry}, shut)
        self._given, self._coming = flown.stated_N_s, flown.coming
        return flown.used_N_s

    def _none(self) -> Array:
        return np.zeros(len(self.scenario.chaser.thrusters))

    def state(self) -> StackState:
        """Return the true state."""
        stack = self.stack
        motion = StackMotion(
            stack.body.mass_kg * rotations.rotate_inverse(stack.q_wxyz, stack.velocity_m_s),
            stack.body.inertia_kg_m2 @ stack.omega_rad_s,
        )
        return StackState(stack.body, stack.mounted, motion, stack.q_wxyz)


def fly_controlled(
    scenario: Scenario,
    duration_s: float,
    identify_s: float = 0.0,
    loss: tuple[float, int] | None = None,
) -> StackFlight:
    """Stop a stack from the first tick on, after ``identify_s`` of identifying pulses. ``loss``: time and chaser that dies."""
    flight, rate_hz = ControlledStack(scenario), scenario.time.rate_hz
    true = flight.state()
    least = least_time(scenario, true.body, dict(true.chasers), true.motion)
    rate_deg_s = math.degrees(flight.stack.rates()[1])
    limits, impulses, inside, refused = scenario.detumble, [], [], ""
    settle, begin = 2, round(identify_s * rate_hz) + 2
    holding = 0
    for k in range(begin + round(duration_s * rate_hz)):
        if loss is not None and k >= begin + round(loss[0] * rate_hz):
            flight.lost = frozenset({loss[1]})
        observation, estimation = flight.estimate()
        state = flight.control.state(observation, estimation)
        if k == begin and state is not None:
            refused = flight.control.why_not(state, set(observation.odometry), {})
            if refused:
                break
        task = None if k < settle else StackTask.IDENTIFY if k < begin else StackTask.STOP
        if task is StackTask.STOP and state is not None:
            at_rest = flight.control.is_stopped(state)
            holding = holding + 1 if at_rest or (holding and not flight.control.moves_again(state)) else 0
            task = StackTask.HOLD if holding > 0.5 * rate_hz else StackTask.STOP
        used = flight.step(task, observation, estimation)
        if k >= begin:
            impulses.append(used)
            speed, rate = flight.stack.rates()
            inside.append(speed < limits.speed_m_s and math.degrees(rate) < limits.rate_deg_s)
    since = len(inside) - next((n for n, x in enumerate(reversed(inside)) if not x), len(inside))
    stopped = bool(inside) and since < len(inside)
    speed, rate = flight.stack.rates()
    return StackFlight(
        seed=scenario.seed,
        rate_deg_s=rate_deg_s,
        refused=refused,
        time_s=since / rate_hz if stopped else None,
        impulse_N_s=float(sum(impulses[:since])),
        held_N_s=float(sum(impulses[since:])),
        least=least,
        final_rate_deg_s=math.degrees(rate),
        final_speed_m_s=speed,
        failed="; ".join(flight.events),
        **identification_errors(flight),
    )


def identification_errors(flight: ControlledStack) -> dict[str, float]:
    """Return the errors of the identified mass properties."""
    found, true = flight.identification.target, properties_of(flight.stack.target)
    error = found.values - true
    largest = float(np.linalg.eigvalsh(flight.stack.target.inertia_kg_m2)[-1])
    _, estimation = flight.estimate()
    stack = estimation.stack
    nees = math.nan
    if stack is not None:
        off = stack.stack.values - properties_of(flight.stack.body)
        nees = float(off @ np.linalg.solve(stack.stack.covariance, off)) / len(off)
    return {
        "mass_share": abs(float(error[0])) / float(true[0]),
        "centre_m": float(np.linalg.norm(error[1:4])),
        "inertia_share": float(np.abs(error[4:]).max()) / largest,
        "nees": nees,
    }


def wrong_knowledge(seed: int, share: float = 0.3, errors: bool = True) -> list[str]:
    """Return scenario overrides of ``detumble``: the controllers' stated mass and inertia are wrong by ``share``, the stated
    inertia is that of a ball, and its centre of mass the middle of the body; thrusts and pulses have errors with ``errors``."""
    rng = np.random.default_rng([seed, 0xBAD])
    mass, inertia = (1.0 + share * rng.choice([-1.0, 1.0]) for _ in range(2))
    true = (
        "mass_kg=150.0,inertia_kg_m2=[16.73,20.29,22.98,-2.41,1.95,-1.41],centre_of_mass_m=[0.06,-0.05,0.04]"
    )
    moment = 20.0 * inertia
    out = [
        f"truth.values=[{{target=true,{true}}}]",
        f"target.mass_kg={150.0 * mass}",
        f"target.inertia_kg_m2=[{moment},{moment},{moment}]",
        "target.inertia_products_kg_m2=[0.0,0.0,0.0]",
        "target.centre_of_mass_m=[0.0,0.0,0.0]",
        "target.mass_sigma_share=0.3",
        "target.inertia_sigma_share=0.3",
        "target.centre_of_mass_sigma_m=0.1",
        "detumble.identification.enabled=true",
    ]
    return out + (
        ["truth.chaser.thrust_share=0.03", "truth.chaser.pulse_scatter_share=0.02"] if errors else []
    )
