# SPDX-License-Identifier: Apache-2.0
"""Scenarios with a training task, for the tests of chaserdock.envs."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import Scenario, load_scenario, parse_scenario
from chaserdock_protocol.shipped_scenarios import shipped_scenario

from chaserdock.toml_text import toml_value

REWARD = {
    "progress_per_m": 7.0,
    "turn_per_rad": 3.0,
    "distance_per_m_s": 0.4,
    "angle_per_rad_s": 0.3,
    "impulse_per_N_s": 0.2,
    "time_per_s": 0.05,
    "success": 50.0,
    "failure": 30.0,
}

START = {
    "position_m": [0.1, 0.2, 0.2],
    "rotation_deg": 8.0,
    "velocity_m_s": 0.02,
    "rate_deg_s": 1.0,
    "target_rate_deg_s": 1.0,
}
"""Spread of the start."""


def start_of(task: str) -> dict[str, Any]:
    """The spread of the start that a task may have."""
    rate = {"target_rate_deg_s": START["target_rate_deg_s"]}
    return rate if task == "detumble" else START


def learning(task: str = "dock", **keys: Any) -> dict[str, Any]:
    """The table [learning]."""
    return {"task": task, "episode_s": 20.0, "reward": REWARD} | keys


def docking(*overrides: str, **keys: Any) -> Scenario:
    """`docking-contact` with a task: ``keys`` of [learning]."""
    table = f"learning={toml_value(learning(**keys))}"
    return load_scenario(shipped_scenario("docking-contact"), [table, *overrides])


ALONG_PORT: dict[str, Any] = {
    "name": "along-port",
    "duration_s": 10.0,
    "navigation": {"grade": "exact"},
    "target": {"model": "servicer", "motion": "torque_free", "mass_kg": 40.0,
               "velocity_m_s": [0.0, 0.0, 0.0], "omega_rad_s": [0.0, 0.0, 0.0]},
    "chaser": {"body": "tetra12", "actuation": "ideal", "size_m": [0.14, 0.33, 0.33],
               "probe_reach_m": 0.35},
    "limits": {"min_distance_target_m": 0.5},
    "docking": {"kind": "capture", "final": {"lateral_speed_m_s": 0.012},
                "ports": [{"chaser": 0, "position_m": [-0.2, 0.0, -0.05],
                           "axis": [-1.0, 0.0, 0.0]}]},
    "chasers": [{"position_m": [-1.0, 0.0, -0.05], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
}  # fmt: skip
"""A chaser 0.45 m before the port of a target at rest."""


def along_port(
    offset_m: tuple[float, float, float],
    velocity_m_s: tuple[float, float, float],
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **changes: Any,
) -> Scenario:
    """A chaser that drifts, from ``offset_m`` off its place before the port."""
    values = copy.deepcopy(ALONG_PORT)
    values["chasers"][0] |= {
        "start_offset_m": list(offset_m),
        "start_velocity_m_s": list(velocity_m_s),
        "start_rotation_rad": list(rotation_rad),
    }
    return parse_scenario(values | {"learning": learning()} | changes, "test")


SEVERAL: dict[str, Any] = ALONG_PORT | {
    "chasers": [
        {"position_m": [-1.0, 0.0, -0.05], "q_wxyz": [1.0, 0.0, 0.0, 0.0],
         "start_offset_m": [0.42, 0.0, 0.0], "start_velocity_m_s": [0.018, 0.0, 0.0]},
        {"position_m": [1.5, 0.0, 0.0], "q_wxyz": [0.0, 0.0, 0.0, 1.0]},
        {"position_m": [0.0, 0.0, 2.0], "look_at": "target"},
    ],
    "docking": ALONG_PORT["docking"] | {"ports": [
        {"chaser": 0, "position_m": [-0.2, 0.0, -0.05], "axis": [-1.0, 0.0, 0.0]},
        {"chaser": 1, "position_m": [0.2, 0.0, 0.0], "axis": [1.0, 0.0, 0.0]},
        {"chaser": 2, "position_m": [0.0, 0.0, 0.16], "axis": [0.0, 0.0, 1.0]},
    ]},
    "target": ALONG_PORT["target"] | {"omega_rad_s": [0.004, 0.0, 0.0]},
    "learning": learning(),
}  # fmt: skip
"""Three chasers with a port each; the first drifts into its own."""


def actuator_command(
    scenario: Scenario, tick: int, action: Array, chaser: int = 0
) -> ActuatorCommand:
    """The command of the world's actuators for an action (actuators,)."""
    timing, body = scenario.timing, scenario.chaser
    at = timing.step_of_tick(tick) + timing.latency_steps
    given: dict[str, Any] = {"force_N": (0.0,) * 3, "torque_N_m": (0.0,) * 3, "pulses": ()}
    if body.actuation == "ideal":
        wrench = (np.clip(action, -1.0, 1.0) * body.wrench_max).tolist()
        given |= {"force_N": tuple(wrench[:3]), "torque_N_m": tuple(wrench[3:])}
    else:
        pulses = []
        for k, (thruster, level) in enumerate(
            zip(body.thrusters, np.clip(action, 0.0, 1.0).tolist(), strict=True)
        ):
            steps = int(level * timing.steps_per_tick + 0.5)
            off_s = (timing.steps_per_tick - steps) / timing.physics_hz
            if off_s <= thruster.fall_s + 1e-9:
                steps = timing.steps_per_tick
            if steps / timing.physics_hz >= thruster.min_on_s - 1e-9:
                pulses.append(
                    ThrusterPulse(
                        thruster=k,
                        open_ns=timing.time_ns(at),
                        close_ns=timing.time_ns(at + steps),
                    )
                )
        given["pulses"] = tuple(pulses)
    return ActuatorCommand(
        chaser=chaser,
        tick=tick,
        seq=tick,
        sim_time_ns=timing.tick_time_ns(tick),
        effective_time_ns=timing.time_ns(at),
        source="command",
        **given,
    )
