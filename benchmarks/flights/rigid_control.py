# SPDX-License-Identifier: Apache-2.0
"""The controller's identification and detumbling in closed loop with a rigid stack: fast, for
statistics over many tumbles.

Odometry, thrusters and their errors are those of the simulator. The physics engine and the images
are left out: the pose of the target, by which the places of the chasers are first known, has a
constant error drawn with ``_POSE_M`` and ``_POSE_RAD``. ``detumble_flights.fly_stack`` flies the
same with both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from chaserdock_controller.bodies.mass_properties import properties_of
from chaserdock_controller.estimation.identification.stage import StackIdentification
from chaserdock_controller.guidance.detumble.control import DetumbleControl, StackState, StackTask
from chaserdock_controller.guidance.detumble.planning import plan_stop
from chaserdock_controller.guidance.detumble.stack import StackMotion
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    ChaserObservation,
    Observation,
    OwnMotion,
    TargetEstimation,
    TargetState,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import Scenario, flight_scenario

from .detumble_flights import DetumbleLog, DetumbleOutcome, least_time
from .rigid_stack import RigidStack, StackStep

_POSE_M, _POSE_RAD = 0.001, math.radians(0.1)
"""Sigma of the constant error of the target's pose, per axis."""
_SETTLE_TICKS = 2
"""Ticks without thrust, until the identification has odometry at two times."""
_OPTIMUM_STEP_S = 0.5
"""Step of the plan whose least impulse is searched."""
_SILENT_REST_S = 10.0
"""A flight without controller ends so long after the stack came to rest."""


class ControlledStack:
    """A rigid stack and its controller, one ``step`` per tick. ``lost``: chasers that are dead: no
    odometry, no thrust.

    ``reported``: thrusters that their chasers report as failed and have shut off, by chaser.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.stack = scenario, RigidStack(scenario, port_errors=True)
        flight = flight_scenario(scenario)
        self.identification, self.control = StackIdentification(flight), DetumbleControl(flight)
        self.lost: frozenset[int] = frozenset()
        self.reported: Mapping[int, tuple[int, ...]] = {}
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
        none = np.zeros(6)
        observation = Observation(
            tick=stack.tick,
            time_ns=now_ns,
            effective_ns=effective_ns,
            chasers=tuple(
                ChaserObservation(
                    i,
                    input_limits=none,
                    odometry=odometry.get(i),
                    thruster_impulses=self._given.get(i) if i in odometry else None,
                    ahead=((1.0, self._coming[i]),) if i in self._coming and seconds else (),
                    isolated=self.reported.get(i, ()),
                )
                for i in stack.mounted
            ),
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
            now_ns,
            position,
            velocity,
            q,
            stack.omega_rad_s,
            1e-6 * np.eye(12),
            "tracking",
            len(odometry),
            (),
        )
        return TargetEstimation(
            target=target,
            at_effect=target,
            chasers=tuple(
                ChaserEstimate(
                    i,
                    own=OwnMotion(odometry[i], np.zeros(13), np.zeros(6))
                    if i in odometry
                    else None,
                    visible=i in odometry,
                    latched=True,
                )
                for i in stack.mounted
            ),
            body=self.identification.target.body,
        )

    def step(
        self, task: StackTask | None, observation: Observation, estimation: TargetEstimation
    ) -> StackStep:
        """Fly one tick with a task of the thrusters, None for no thrust."""
        self.events += [text for _, text in estimation.events]
        commands: Mapping[int, Array] = {}
        present = present_chasers(observation)
        state = self.control.state(observation, estimation)
        if task is not None and state is not None:
            directs = self.control.commands(state, set(present), task, observation)
            commands = {i: d.thrusts_N for i, d in directs.items() if d.thrusts_N is not None}
        return self._fly({i: commands.get(i, self._none()) for i in present})

    def damp(self) -> StackStep:
        """Fly one tick without the controller: every chaser damps the stack by its own odometry."""
        damping = self.stack.damping()
        return self._fly({i: thrusts for i, thrusts in damping.items() if i not in self.lost})

    def _fly(self, thrusts_N: Mapping[int, Array]) -> StackStep:
        flown = self.stack.step(thrusts_N, self._shut())
        self._given, self._coming = flown.stated_N_s, flown.coming
        return flown

    def _shut(self) -> dict[int, tuple[int, ...]]:
        """Return the thrusters whose shut-off valve is closed."""
        found = sorted(self.identification.failed)
        return {
            i: (*(k for chaser, k in found if chaser == i), *self.reported.get(i, ()))
            for i in {i for i, _ in found} | self.reported.keys()
        }

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


def present_chasers(observation: Observation) -> list[int]:
    """Return the chasers with odometry."""
    return [c.chaser for c in observation.chasers if c.odometry is not None]


@dataclass(frozen=True)
class FlightEvents:
    """What happens in a flight, in seconds after the command to stop. ``loss``: time and chaser
    that dies. ``reported``: chaser and thruster that it reports as failed from the start.
    ``silent_from_s``: from then on the chasers are without a controller."""

    loss: tuple[float, int] | None = None
    reported: tuple[int, int] | None = None
    silent_from_s: float = math.inf


def fly_controlled(
    scenario: Scenario,
    duration_s: float,
    identify_s: float = 0.0,
    events: FlightEvents | None = None,
) -> DetumbleOutcome:
    """Stop a stack from the first tick on, after ``identify_s`` of identifying pulses."""
    flight, rate_hz = ControlledStack(scenario), scenario.time.rate_hz
    events = events or FlightEvents()
    if events.reported is not None:
        flight.reported = {events.reported[0]: (events.reported[1],)}
    true = flight.state()
    least = least_time(scenario, true.body, dict(true.chasers), true.motion)
    rate_deg_s = math.degrees(flight.stack.rates()[1])
    log, refused = DetumbleLog(scenario.detumble, 1.0 / rate_hz), ""
    begin = round(identify_s * rate_hz) + _SETTLE_TICKS
    tasks = _Tasks(begin, rate_hz)
    for k in range(begin + round(duration_s * rate_hz)):
        since_s = (k - begin) / rate_hz
        silent = since_s >= events.silent_from_s
        if events.loss is not None and since_s >= events.loss[0]:
            flight.lost = frozenset({events.loss[1]})
        if silent:
            flown = flight.damp()
        else:
            observation, estimation = flight.estimate()
            state = flight.control.state(observation, estimation)
            if k == begin and state is not None:
                refused = flight.control.why_not(state, set(present_chasers(observation)))
                if refused:
                    break
            flown = flight.step(tasks.at(k, flight.control, state), observation, estimation)
        if k >= begin:
            load = flown.peak_force_N, flown.peak_torque_N_m
            log.add(flown.used_N_s, flight.stack.rates(), load)
            if silent and log.at_rest_s >= _SILENT_REST_S:
                break
    identified = {} if math.isfinite(events.silent_from_s) else identification_errors(flight)
    return DetumbleOutcome(
        seed=scenario.seed,
        rate_deg_s=rate_deg_s,
        refused=refused,
        least=least,
        failed="; ".join(flight.events),
        **log.figures(),
        **identified,
    )


class _Tasks:
    """The task of every tick: nothing while the filter settles, identifying pulses until the
    command at tick ``begin``, then to stop, and to hold once the stack has been at rest for half a
    second."""

    def __init__(self, begin: int, rate_hz: int) -> None:
        self._begin, self._rest_ticks, self._holding = begin, 0.5 * rate_hz, 0

    def at(self, tick: int, control: DetumbleControl, state: StackState | None) -> StackTask | None:
        if tick < self._begin or state is None:
            return (
                None
                if tick < _SETTLE_TICKS
                else StackTask.IDENTIFY
                if tick < self._begin
                else StackTask.STOP
            )
        control.follow(state)
        rests = control.is_stopped(state) or (self._holding and not control.moves_again(state))
        self._holding = self._holding + 1 if rests else 0
        return StackTask.HOLD if self._holding > self._rest_ticks else StackTask.STOP


def identification_errors(flight: ControlledStack) -> dict[str, Any]:
    """Return the errors of the identified mass properties, by field of ``DetumbleOutcome``."""
    found, true = flight.identification.target, properties_of(flight.stack.target)
    error = found.values - true
    largest = float(np.linalg.eigvalsh(flight.stack.target.inertia_kg_m2)[-1])
    _, estimation = flight.estimate()
    stack, nees = estimation.stack, None
    if stack is not None:
        off = stack.stack.values - properties_of(flight.stack.body)
        nees = float(off @ np.linalg.solve(stack.stack.covariance, off)) / len(off)
    return {
        "mass_share": abs(float(error[0])) / float(true[0]),
        "centre_m": float(np.linalg.norm(error[1:4])),
        "inertia_share": float(np.abs(error[4:]).max()) / largest,
        "nees": nees,
    }


def optimum_share(scenario: Scenario, seconds: float, guesses: int, programmes: int = 20) -> float:
    """Return the least impulse found that stops a stack in ``seconds``, over that of the programme
    with a frozen attitude: planned at once with the true stack, from so many random guesses, each
    with so many linear programmes."""
    flight = ControlledStack(scenario)
    state = flight.state()
    problem = flight.control.problem(state, set(state.chasers))
    count, rng = round(seconds / _OPTIMUM_STEP_S), np.random.default_rng([scenario.seed, 0x0971])
    shape, plans = (count, len(problem.limits_N)), []
    for _ in range(guesses):
        guess = np.where(rng.random(shape) < rng.choice([0.05, 0.15, 0.3]), problem.limits_N, 0.0)
        plans.append(plan_stop(problem, guess, seconds / count, programmes).cost_N_s)
    least = least_time(scenario, state.body, dict(state.chasers), state.motion)
    if least is None:
        raise ValueError("the stack cannot be stopped with a frozen attitude")
    return min(plans) / least.impulse_N_s


_MASS, _MOMENTS, _PRODUCTS, _CENTRE = (
    "150.0",
    "16.73,20.29,22.98",
    "-2.41,1.95,-1.41",
    "[0.06,-0.05,0.04]",
)
"""Mass properties of the target in ``wrong_knowledge``: kg, kg m² and m, TRF axes."""


def right_knowledge() -> list[str]:
    """Return scenario overrides after those of ``wrong_knowledge`` by which the controllers' stated
    mass properties are right.
    """
    return [
        f"target.mass_kg={_MASS}",
        f"target.inertia_kg_m2=[{_MOMENTS}]",
        f"target.inertia_products_kg_m2=[{_PRODUCTS}]",
        f"target.centre_of_mass_m={_CENTRE}",
        "target.mass_sigma_share=0.003",
        "target.inertia_sigma_share=0.003",
        "target.centre_of_mass_sigma_m=0.001",
    ]


def wrong_knowledge(seed: int, share: float = 0.3, errors: bool = True) -> list[str]:
    """Return scenario overrides of ``detumble``: the controllers' stated mass and inertia are wrong
    by ``share``, the stated inertia is that of a ball, and its centre of mass the middle of the
    body; thrusts and pulses have errors with ``errors``."""
    rng = np.random.default_rng([seed, 0xBAD])
    mass, inertia = (1.0 + share * rng.choice([-1.0, 1.0]) for _ in range(2))
    true = f"mass_kg={_MASS},inertia_kg_m2=[{_MOMENTS},{_PRODUCTS}],centre_of_mass_m={_CENTRE}"
    moment = 20.0 * inertia
    out = [
        f"truth.values=[{{target=true,{true}}}]",
        f"target.mass_kg={float(_MASS) * mass}",
        f"target.inertia_kg_m2=[{moment},{moment},{moment}]",
        "target.inertia_products_kg_m2=[0.0,0.0,0.0]",
        "target.centre_of_mass_m=[0.0,0.0,0.0]",
        "target.mass_sigma_share=0.3",
        "target.inertia_sigma_share=0.3",
        "target.centre_of_mass_sigma_m=0.1",
        "detumble.identification.enabled=true",
    ]
    return out + (
        ["truth.chaser.thrust_share=0.03", "truth.chaser.pulse_scatter_share=0.02"]
        if errors
        else []
    )
