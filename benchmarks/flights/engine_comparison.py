# SPDX-License-Identifier: Apache-2.0
"""The same motion on each physics engine (``world.engine``), and how far apart the bodies are.

The cases are open loop: loads do not depend on the states, so that differences of the engines are
not hidden by control.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.port_loads import IntervalLoads
from chaserdock_world.physics.simulation import TARGET, Physics
from chaserdock_world.rendering.cameras import States

from . import load_shipped
from .latched_stack import moving_with
from .momentum import momentum_of

ENGINES = ("pybullet", "mujoco")
_TUMBLE = "target.omega_rad_s=[0.045, 0.135, 0.09]"
_GAP_M, _CLOSING_M_S = 0.002, 0.01
"""Start of a capture: the tip touches after a fifth of a second."""
_FAR_M = 10.0
"""Distance from the target at which nothing touches in 30 s."""

Advance = Callable[[int], None]
"""Makes the steps up to a step."""


@dataclass(frozen=True)
class EngineCase:
    """``start`` sets the initial state and returns what advances the physics.

    ``isolated``: groups of bodies on which no other one, and no actuator, acts.
    """

    scenario: Scenario
    start: Callable[[Physics], Advance]
    isolated: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class EngineFlight:
    """A case on one engine: states and port loads at each tick.

    ``latched_ticks``: first tick at which a latch was closed. ``step_s``: processor time per
    physics step. ``momentum_error``, ``angular_momentum_error``: relative change from the begin to
    the end, the largest of the isolated groups; the latter about the common centre of mass of a
    group.
    """

    states: tuple[States, ...]
    loads: tuple[Mapping[str, IntervalLoads], ...]
    latched_ticks: Mapping[str, int]
    momentum_error: float
    angular_momentum_error: float
    step_s: float


@dataclass(frozen=True)
class EngineDifference:
    """Largest differences of two flights: of any body's position (m), attitude (rad), and of any
    port's force (N) and torque (N m).
    """

    position_m: float
    angle_rad: float
    force_N: float
    torque_N_m: float


def free_case(seed: int = 0) -> EngineCase:
    """Four chasers and a target with errors of mass, inertia and centre of mass, all tumbling,
    without loads.
    """
    scenario = _scenario(
        _TUMBLE, "truth.preset=mismatch", "truth.chaser={force_N=0.0, torque_N_m=0.0}", seed=seed
    )

    def start(physics: Physics) -> Advance:
        _spread(physics, np.random.default_rng(seed))
        return lambda step: _coast(physics, step)

    return EngineCase(scenario, start, ((TARGET,), *((f"chaser/{i}",) for i in range(4))))


def thruster_case(seed: int = 0) -> EngineCase:
    """As ``free_case``, with disturbances and pulses of three random thrusters of each chaser in
    every tick.
    """
    scenario = _scenario(_TUMBLE, "truth.preset=mismatch", seed=seed)

    def start(physics: Physics) -> Advance:
        rng = np.random.default_rng(seed)
        _spread(physics, rng)
        return _firing(scenario, physics, rng)

    return EngineCase(scenario, start)


def capture_case(seed: int = 0) -> EngineCase:
    """Chaser 0 drifts into the port of the tumbling target at 1 cm/s and latches; no loads. The
    others are far away.
    """
    scenario = _scenario(_TUMBLE, seed=seed)

    def start(physics: Physics) -> Advance:
        _spread(physics, np.random.default_rng(seed))
        physics.place(
            "chaser/0", before_port(scenario, physics.state(TARGET), 0, _GAP_M, _CLOSING_M_S)
        )
        physics.command_latch(0, "arm", 0)
        return lambda step: _coast(physics, step)

    return EngineCase(
        scenario, start, ((TARGET, "chaser/0"), ("chaser/1",), ("chaser/2",), ("chaser/3",))
    )


def stack_case(seed: int = 0) -> EngineCase:
    """Three latched chasers fire random thrusters; the fourth is far away. With errors as
    ``thruster_case``.
    """
    scenario = _scenario(_TUMBLE, "truth.preset=mismatch", seed=seed)

    def start(physics: Physics) -> Advance:
        rng = np.random.default_rng(seed)
        _spread(physics, rng)
        for latch in physics.latches.values():
            state = before_port(scenario, physics.state(TARGET), latch.chaser, 0.0, 0.0)
            physics.place(f"chaser/{latch.chaser}", state)
            physics.close_latch(latch.chaser)
        return _firing(scenario, physics, rng)

    return EngineCase(scenario, start)


CASES: dict[str, Callable[[int], EngineCase]] = {
    "free": free_case,
    "thrusters": thruster_case,
    "capture": capture_case,
    "stack": stack_case,
}


def fly_case(case: EngineCase, engine: str, duration_s: float) -> EngineFlight:
    """Fly a case on an engine."""
    world = case.scenario.world.model_copy(update={"engine": engine})
    scenario = case.scenario.model_copy(update={"world": world})
    timing, physics = scenario.timing, Physics(scenario)
    try:
        advance = case.start(physics)
        first, states, loads, latched = _momenta(case, physics), [], [], {}
        started_s = time.process_time()
        for tick in range(1, round(duration_s * timing.rate_hz) + 1):
            advance(timing.step_of_tick(tick))
            states.append({name: physics.state(name) for name in physics.bodies})
            loads.append({name: recorder.take() for name, recorder in physics.port_loads.items()})
            for name, latch in physics.latches.items():
                if latch.latched:
                    latched.setdefault(name, tick)
        step_s = (time.process_time() - started_s) / physics.step_count
        changes = [
            np.linalg.norm(after - before, axis=1) / np.linalg.norm(before, axis=1)
            for before, after in zip(first, _momenta(case, physics), strict=True)
        ]
        linear, angular = np.max(changes, axis=0).tolist() if changes else (0.0, 0.0)
        return EngineFlight(tuple(states), tuple(loads), latched, linear, angular, step_s)
    finally:
        physics.close()


def difference(a: EngineFlight, b: EngineFlight) -> EngineDifference:
    """Return the largest differences of two flights of one case."""
    position_m = angle_rad = force_N = torque_N_m = 0.0
    for first, second in zip(a.states, b.states, strict=True):
        for name, state in first.items():
            other = second[name]
            position_m = max(position_m, float(np.linalg.norm(state.position_m - other.position_m)))
            turn = rotations.log(
                rotations.multiply(rotations.conjugate(state.q_wxyz), other.q_wxyz)
            )
            angle_rad = max(angle_rad, float(np.linalg.norm(turn)))
    for first, second in zip(a.loads, b.loads, strict=True):
        for name, load in first.items():
            other = second[name]
            force_N = max(force_N, float(np.linalg.norm(load.force_N - other.force_N)))
            torque_N_m = max(torque_N_m, float(np.linalg.norm(load.torque_N_m - other.torque_N_m)))
    return EngineDifference(position_m, angle_rad, force_N, torque_N_m)


def before_port(
    scenario: Scenario, target: BodyState, chaser: int, gap_m: float, closing_m_s: float
) -> BodyState:
    """Return the state of a chaser in line with its port, its tip ``gap_m`` before it, closing in
    on it in the target's frame.
    """
    port = next(p for p in scenario.docking.ports if p.chaser == chaser)
    axis, q_off = np.array(port.axis), np.asarray(scenario.chasers[chaser].q_wxyz)
    offset = np.array(port.position_m) + (gap_m + scenario.chaser.probe_reach_m) * axis
    still = moving_with(target, offset, q_off)
    closing = rotations.rotate(target.q_wxyz, closing_m_s * axis)
    return replace(still, velocity_m_s=still.velocity_m_s - closing)


def _scenario(*overrides: str, seed: int) -> Scenario:
    return load_shipped("four-chaser-capture", f"seed={seed}", *overrides)


def _spread(physics: Physics, rng: np.random.Generator) -> None:
    """Place the chasers so far apart that nothing touches, with random attitudes, velocities and
    rates.
    """
    for i, name in enumerate(name for name in physics.bodies if name != TARGET):
        position = _FAR_M * np.array([np.cos(2.0 * i), np.sin(2.0 * i), 0.0])
        q = rotations.exp(rng.uniform(-1.0, 1.0, 3))
        physics.place(
            name, BodyState(position, rng.uniform(-0.05, 0.05, 3), q, rng.uniform(-0.2, 0.2, 3))
        )


def _firing(scenario: Scenario, physics: Physics, rng: np.random.Generator) -> Advance:
    """Return what advances the physics under random pulses, new ones in each call."""
    chasers, hz = range(len(scenario.chasers)), scenario.time.physics_hz
    actuators = {f"chaser/{i}": make_actuators(scenario, i) for i in chasers}

    def advance(step: int) -> None:
        begin = physics.step_count
        for i in chasers:
            pulses = []
            for thruster in rng.choice(len(scenario.chaser.thrusters), 3, replace=False).tolist():
                opens, closes = (
                    round(float(s) / hz * 1e9) for s in sorted(rng.uniform(begin, step, 2))
                )
                pulses.append(ThrusterPulse(thruster=thruster, open_ns=opens, close_ns=closes))
            command = ActuatorCommand(
                chaser=i,
                effective_time_ns=round(begin / hz * 1e9),
                source="command",
                force_N=(0.0, 0.0, 0.0),
                torque_N_m=(0.0, 0.0, 0.0),
                pulses=tuple(pulses),
            )
            actuators[f"chaser/{i}"].command(command, begin, begin)
        fly_to(step, physics, actuators, 1.0 / hz)

    return advance


def _momenta(case: EngineCase, physics: Physics) -> list[Array]:
    """Return momentum and angular momentum (2, 3) of each isolated group."""
    found = [momentum_of(physics, group) for group in case.isolated]
    return [np.array([m.linear_N_s, m.angular_N_m_s]) for m in found]


def _coast(physics: Physics, step: int) -> None:
    """Advance without loads."""
    physics.advance(step - physics.step_count, {})
