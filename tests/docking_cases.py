# SPDX-License-Identifier: Apache-2.0
"""Builders shared by the tests of docking by capture: a servicer, a chaser before its port, a world
and a guidance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_controller.guidance.docking import DockingObservation
from chaserdock_controller.guidance.phases import Trigger
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import PortView
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_world.physics.simulation import TARGET, BodyState, Physics
from flight_cases import at, fleet_of, order, step

TARGET_KG, CHASER_KG = 40.0, 17.8
TARGET_INERTIA, CHASER_INERTIA = (0.683, 0.875, 0.9), (0.3, 0.31, 0.33)
REACH_M = 0.35
HZ = 960
DT_S = 0.1
PORTS = (
    {"chaser": 0, "position_m": [-0.2, 0.0, -0.05], "axis": [-1.0, 0.0, 0.0]},
    {"chaser": 1, "position_m": [0.2, 0.0, -0.05], "axis": [1.0, 0.0, 0.0]},
    {"chaser": 2, "position_m": [-0.2, 0.0, 0.1], "axis": [-1.0, 0.0, 0.0]},
    {"chaser": 3, "position_m": [0.0, 0.16, 0.0], "axis": [0.0, 1.0, 0.0]},
)
_HALF = float(np.sqrt(0.5))
ONE_BY_ONE = [
    {"at_s": 900.0, "command": "approach", "chasers": [0]},
    {"at_s": 910.0, "command": "retreat", "chasers": [0]},
    {"at_s": 920.0, "command": "approach", "chasers": [2]},
]
"""Timeline by which chasers 0 and 2, whose ports are near, never dock at the same time."""
CHASERS = (
    {"position_m": [-1.0, 0.0, -0.05], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
    {"position_m": [1.0, 0.0, -0.05], "q_wxyz": [0.0, 0.0, 0.0, 1.0]},
    {"position_m": [-1.3, 0.0, 0.35], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
    {"position_m": [0.0, 1.0, 0.0], "q_wxyz": [_HALF, 0.0, 0.0, -_HALF]},
)


def values(chasers: int = 1, **changes: Any) -> dict[str, Any]:
    """The tables of a scenario with as many chasers, each with its port."""
    out: dict[str, Any] = {
        "name": "test",
        "duration_s": 60.0,
        "navigation": {"grade": "exact"},
        "target": {
            "model": "servicer",
            "motion": "torque_free",
            "mass_kg": TARGET_KG,
            "inertia_kg_m2": TARGET_INERTIA,
        },
        "chaser": {
            "mass_kg": CHASER_KG,
            "size_m": [0.14, 0.33, 0.33],
            "inertia_kg_m2": CHASER_INERTIA,
            "torque_max_N_m": 0.4,
        },
        "limits": {"min_distance_target_m": 0.75},
        "docking": {"kind": "capture", "ports": list(PORTS[:chasers])},
        "chasers": list(CHASERS[:chasers]),
        "timeline": ONE_BY_ONE if chasers > 2 else [],
    }
    for key, value in changes.items():
        out[key] = {**out[key], **value} if isinstance(value, dict) and key in out else value
    return out


def scenario(chasers: int = 1, **changes: Any) -> Scenario:
    return parse_scenario(values(chasers, **changes), "test")


def world(
    gap_m: float = 0.002,
    closing_m_s: float = 0.01,
    lateral_m: float = 0.0,
    turn_rad: float = 0.0,
    omega_rad_s: tuple[float, float, float] = (0.045, 0.135, 0.09),
    **changes: Any,
) -> Physics:
    """Chaser 0 with its tip ``gap_m`` before its port, closing in on the tumbling target in the
    target's own frame.
    """
    mission = scenario(target={"omega_rad_s": list(omega_rad_s)}, **changes)
    physics = Physics(mission)
    target = physics.state(TARGET)
    turn = rotations.exp((0.0, 0.0, turn_rad))
    tip = np.array([-0.2 - gap_m, lateral_m, -0.05])
    offset = tip - rotations.rotate(turn, (REACH_M, 0.0, 0.0))
    moving = rotations.cross(target.omega_rad_s, offset) + np.array([closing_m_s, 0.0, 0.0])
    state = BodyState(
        target.position_m + rotations.rotate(target.q_wxyz, offset),
        target.velocity_m_s + rotations.rotate(target.q_wxyz, moving),
        rotations.multiply(target.q_wxyz, turn),
        rotations.rotate_inverse(turn, target.omega_rad_s),
    )
    physics.place("chaser/0", state)
    return physics


def latch(physics: Physics) -> None:
    """Let chaser 0 drift into its port and latch."""
    physics.command_latch(0, "arm", 0)
    for _ in range(HZ):
        if physics.latches["chaser/0"].latched:
            return
        physics.advance(1, {})
    raise AssertionError("it does not latch")


def momenta(physics: Physics, name: str) -> tuple[Array, Array]:
    """Momentum (3,) and angular momentum (3,) of a body about WRF's origin, WRF."""
    plant, s = physics.plants[name], physics.state(name)
    arm = rotations.rotate(s.q_wxyz, plant.centre_of_mass_m)
    velocity = s.velocity_m_s + rotations.cross(rotations.rotate(s.q_wxyz, s.omega_rad_s), arm)
    spin = rotations.rotate(s.q_wxyz, plant.inertia_kg_m2 @ s.omega_rad_s)
    return plant.mass_kg * velocity, spin + rotations.cross(
        s.position_m + arm, plant.mass_kg * velocity
    )


def tip_of(state: BodyState) -> Array:
    return state.position_m + rotations.rotate(state.q_wxyz, np.array([REACH_M, 0.0, 0.0]))


def balance(physics: Physics, wrench: Array) -> tuple[Array, Array]:
    """Make one step; return force and torque about the tip (3,) that the chaser's motion demands of
    the port, WRF.
    """
    before, (p, h) = physics.state("chaser/0"), momenta(physics, "chaser/0")
    physics.advance(1, {"chaser/0": wrench})
    p_after, h_after = momenta(physics, "chaser/0")
    plant = physics.plants["chaser/0"]
    force, torque = (
        rotations.rotate(before.q_wxyz, wrench[:3] + plant.disturbance[:3]),
        rotations.rotate(before.q_wxyz, wrench[3:] + plant.disturbance[3:]),
    )
    on_chaser = (p_after - p) * HZ - force
    torque_on_chaser = (h_after - h) * HZ - torque - rotations.cross(before.position_m, force)
    return -on_chaser, -(torque_on_chaser - rotations.cross(tip_of(before), on_chaser))


def senses(offset_m: Any, **changes: Any) -> DockingObservation:
    """Perfectly in line, at rest, at ``offset_m`` (3,), unless stated otherwise."""
    view: dict[str, float] = {
        "gap_m": 0.1,
        "lateral_m": 0.0,
        "angle_rad": 0.0,
        "closing_m_s": 0.0,
        "lateral_speed_m_s": 0.0,
    }
    contact, latched = changes.pop("contact", False), changes.pop("latched", False)
    q: Array = changes.pop("q_wxyz", np.array([1.0, 0.0, 0.0, 0.0]))
    return DockingObservation(
        PortView(**(view | changes)), contact, latched, np.asarray(offset_m, dtype=float), q
    )


class Pilot:
    """Guidance with chasers that are always where their references are, unless stated otherwise."""

    def __init__(self, chasers: int = 1, **changes: Any) -> None:
        self.scenario = scenario(chasers, **changes)
        self.guidance = fleet_of(self.scenario)
        for chaser in self.guidance.chasers:
            chaser.fire(Trigger.TARGET_ACQUIRED, 0.0)
        self.now_s = 0.0
        self.observed: dict[int, dict[str, Any]] = {}
        self.fly(DT_S)

    def phase(self, i: int = 0) -> str:
        return self.guidance.chasers[i].phase

    def ask(self, what: str, i: int = 0, **more: Any) -> tuple[bool, str]:
        command = OperatorCommand(command=what, chaser=i, **more)  # type: ignore[arg-type]
        answer = order(self.guidance, command, self.now_s)
        return answer.accepted, answer.reason

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds / DT_S)):
            self.now_s += DT_S
            for i, chaser in enumerate(self.guidance.chasers):
                position = at(chaser.state.move, self.now_s)[0]
                port = senses(position, **self.observed.get(i, {}))
                step(chaser, self.now_s, port=port)

    def fly_to(self, phase: str, i: int = 0, limit_s: float = 80.0) -> None:
        begun_s = self.now_s
        while self.phase(i) != phase:
            assert self.now_s - begun_s < limit_s, f"still in phase {self.phase(i)}"
            if phase == "contact" and self.phase(i) == "final":
                self.observed[i] = {"contact": True}
            if phase in ("latched", "verified") and self.phase(i) == "final":
                self.observed[i] = {"latched": True}
            self.fly(DT_S)
