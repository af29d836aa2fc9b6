# SPDX-License-Identifier: Apache-2.0
"""Builders shared by the tests of trajectories, guidance and prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from chaserdock_controller.guidance.chaser_machine import ChaserMachine
from chaserdock_controller.guidance.chaser_state import ChaserTick, CommandResult, TrackingErrors
from chaserdock_controller.guidance.docking import DockingObservation
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import Trigger
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.guidance.trajectories import Motion
from chaserdock_controller.interfaces import (
    ChaserInputs,
    ChaserObservation,
    Observation,
    TargetState,
    TickInputs,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry, OperatorCommand, Sighting
from chaserdock_protocol.scenario import FlightScenario, Scenario, parse_scenario
from hypothesis import settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=60)
points = st.tuples(*[st.floats(-3.0, 3.0, allow_subnormal=False)] * 3)
HALF = math.sqrt(0.5)


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 100.0,
        "navigation": {"grade": "exact"},
        "approach": {"dock_distance_m": 0.4, "max_speed_m_s": 0.03},
        "chasers": [
            {"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            {"position_m": [0.0, -1.2, 0.0], "q_wxyz": [HALF, 0.0, 0.0, HALF]},
        ],
    }
    return parse_scenario(values | changes, "test")


def at(move: Motion, t: float) -> tuple[Array, Array, Array]:
    p, v, a = move.at(np.array([t]))
    return p[0], v[0], a[0]


_STILL = np.zeros(3)
TARGET_AT_REST = TargetState(
    0, _STILL, _STILL, np.array([1.0, 0.0, 0.0, 0.0]), _STILL, np.eye(12) * 1e-8, "tracking", 0, ()
)


def fleet_of(scenario: FlightScenario, acquired_s: float | None = None) -> ChaserFleet:
    """Return the chasers of a scenario; they hold if the target is ``acquired_s``."""
    fleet = GuidanceStage(scenario).fleet
    if acquired_s is not None:
        for chaser in fleet.chasers:
            chaser.fire(Trigger.TARGET_ACQUIRED, acquired_s)
        drain(fleet)
    return fleet


def order(fleet: ChaserFleet, command: OperatorCommand, now_s: float) -> CommandResult:
    """Give one command in a tick."""
    return fleet.apply([command], now_s)[0]


def known(now_s: float, **changes: Any) -> ChaserTick:
    """What guidance knows of a chaser: its target is in sight and at rest."""
    return ChaserTick(now_s, **({"own": odometry(), "target": TARGET_AT_REST} | changes))


def step(
    chaser: ChaserMachine,
    now_s: float,
    error_m: float = 0.0,
    error_rad: float = 0.0,
    port: DockingObservation | None = None,
) -> None:
    """Let a chaser do a tick; it is where its reference is."""
    here = known(now_s, offset_m=at(chaser.motion(now_s), now_s)[0], port=port)
    chaser.step(here, TrackingErrors(error_m, error_rad))


def drain(fleet: ChaserFleet) -> list[tuple[int, str, str]]:
    """Return the phase changes since the last call: chaser, phase, detail."""
    changes = [(c.chaser, str(c.phase), c.detail) for c in fleet.changes]
    fleet.drain_events()
    return changes


def odometry(chaser: int = 0, tick: int = 0, time_ns: int = 0, **changes: Any) -> Odometry:
    values: dict[str, Any] = {
        "position_m": (1.0, 2.0, 3.0),
        "velocity_m_s": (0.03, -0.06, 0.0),
        "q_wxyz": (0.5, 0.5, 0.5, 0.5),
        "omega_rad_s": (0.01, 0.0, -0.02),
    }
    return Odometry(tick=tick, sim_time_ns=time_ns, chaser=chaser, **(values | changes))


def start(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=13)
    x[6:10] = rotations.normalize(x[6:10])
    return x


def tick_inputs(
    tick: int,
    time_ns: int,
    odometry: Mapping[int, Odometry],
    sightings: tuple[Sighting, ...] = (),
    commands: tuple[OperatorCommand, ...] = (),
    **by_chaser: Mapping[int, Any],
) -> TickInputs:
    """Return the inputs of a tick; ``by_chaser``: other fields of ``ChaserInputs``."""
    numbers = sorted(odometry.keys() | {i for values in by_chaser.values() for i in values})
    chasers = tuple(
        ChaserInputs(
            i, odometry.get(i), **{name: values.get(i) for name, values in by_chaser.items()}
        )
        for i in numbers
    )
    return TickInputs(tick, time_ns, chasers, sightings, commands)


def observation_of(
    time_ns: int,
    odometry: Mapping[int, Odometry],
    sightings: tuple[Sighting, ...] = (),
    outdated: Mapping[int, Odometry] | None = None,
    chasers: int = 2,
) -> Observation:
    """Return an observation of chasers without docking, thrusters or commands."""
    seen = tuple(
        ChaserObservation(i, np.zeros(6), odometry.get(i), outdated=(outdated or {}).get(i))
        for i in range(chasers)
    )
    return Observation(0, time_ns, time_ns, seen, sightings)
