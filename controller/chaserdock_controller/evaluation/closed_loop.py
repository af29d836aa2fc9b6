"""A mission of the flight code in one process: `Flight`, ideal actuators, rigid bodies. No images, no network.

The same code as in flight decides (references, prediction, NMPC, resolution of commands); only the estimator is
replaced by one that knows. Bodies move by RK4 in steps of at most 20 ms (`prediction.integrate`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import Scenario

from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickInputs, TickOutputs

from .perfect_knowledge import PerfectEstimator


@dataclass(frozen=True)
class Trace:
    """A flight's errors at every tick, K times, N chasers; ``solve_s`` (S,) wall-clock seconds of every solve.

    ``states`` (K, N, 13): p, v (WRF), q_wxyz, omega (body). ``position_error_m``, ``orientation_error_rad`` (K, N): distance
    and angle to the commanded reference pose on the true target at that moment. ``wrenches`` (K, N, 6): what acts.
    """

    time_s: Array
    states: Array
    position_error_m: Array
    orientation_error_rad: Array
    wrenches: Array
    solve_s: Array
    failed_solves: int


def _odometry(chaser: int, tick: int, time_ns: int, x: Array) -> Odometry:
    return Odometry(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=chaser,
        position_m=vector(x[:3]),
        velocity_m_s=vector(x[3:6]),
        q_wxyz=vector(x[6:10]),
        omega_rad_s=vector(x[10:13]),
    )


def _initial(scenario: Scenario) -> Array:
    rows = []
    for i, chaser in enumerate(scenario.chasers):
        position, attitude = scenario.start_pose(i)
        rows.append(np.concatenate([position, chaser.start_velocity_m_s, attitude, np.zeros(3)]))
    return np.array(rows)


def fly_offline(
    scenario: Scenario, delay_s: Callable[[float], float] | None = None, actuator_gain: float = 1.0
) -> Trace:
    """Flies ``scenario`` on perfect knowledge of the target and of the own state.

    ``delay_s``, if given, takes the wall-clock seconds that a solve took and returns how long after the tick
    its command takes effect, in place of the scenario's latency. The controller does not know of it, and skips
    the ticks that pass meanwhile, as a program does that computes for longer than its period. ``actuator_gain``: what
    the actuators give of what they are asked for. Raises ValueError for a target that is not prescribed.
    """
    truth = PerfectEstimator(scenario.target)
    flight = ControllerCore(scenario, time.perf_counter, PerfectEstimator(scenario.target))
    timing, n = scenario.timing, len(scenario.chasers)
    states, acting = _initial(scenario), np.zeros((n, 6))
    waiting: list[tuple[int, Array]] = []
    busy_until_ns, failed, solve_s = 0, 0, []
    history: list[tuple[Array, Array, Array]] = []
    for tick in range(scenario.ticks + 1):
        now_ns = timing.tick_time_ns(tick)
        there = truth.estimate_at(now_ns)
        history.append((states.copy(), acting.copy(), _errors(scenario, flight, there, states, now_ns)))
        if tick == scenario.ticks:
            break
        if now_ns >= busy_until_ns:
            odometry = {i: _odometry(i, tick, now_ns, x) for i, x in enumerate(states)}
            out = flight.step(TickInputs(tick, now_ns, odometry, ()))
            failed += _failures(out)
            took_s = out.solver.wall_solve_s if out.solver is not None else 0.0
            solve_s.append(took_s)
            effective_ns = timing.effective_ns(tick)
            if delay_s is not None:
                effective_ns = busy_until_ns = now_ns + round(delay_s(took_s) * 1e9)
            command = np.array([[*out.wrenches[i].force_N, *out.wrenches[i].torque_N_m] for i in range(n)])
            waiting.append((effective_ns, actuator_gain * command))
        end_ns = timing.tick_time_ns(tick + 1)
        while now_ns < end_ns:
            while waiting and waiting[0][0] <= now_ns:
                acting = waiting.pop(0)[1]
            until_ns = min(end_ns, waiting[0][0] if waiting else end_ns)
            duration_s = (until_ns - now_ns) / 1e9
            states = np.array(
                [propagate(x, u, scenario.chaser, duration_s) for x, u in zip(states, acting, strict=True)]
            )
            now_ns = until_ns
    errors = np.array([h[2] for h in history])
    return Trace(
        time_s=np.array([timing.tick_time_ns(k) / 1e9 for k in range(len(history))]),
        states=np.array([h[0] for h in history]),
        position_error_m=errors[..., 0],
        orientation_error_rad=errors[..., 1],
        wrenches=np.array([h[1] for h in history]),
        solve_s=np.array(solve_s),
        failed_solves=failed,
    )


def _failures(out: TickOutputs) -> int:
    if out.solver is None or not out.solver.status:
        return 1
    return sum(status == "failed" for status in out.solver.status)


def _errors(scenario: Scenario, flight: ControllerCore, there, states: Array, now_ns: int) -> Array:
    """Distance (m) and angle (rad) of every chaser to its reference pose, (N, 2)."""
    out = np.empty((len(states), 2))
    for i, x in enumerate(states):
        offset = flight.guidance.chasers[i].move.at([now_ns / 1e9])[0][0]
        position = there.position_m + rotations.rotate(there.q_wxyz, offset)
        attitude = rotations.multiply(there.q_wxyz, scenario.chasers[i].q_wxyz)
        out[i] = np.linalg.norm(x[:3] - position), rotations.angle_between(attitude, x[6:10])
    return out
