# SPDX-License-Identifier: Apache-2.0
"""What the controller extrapolates in place of lost odometry leaves out the thrust: no estimator
may take it for a measurement.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from chaserdock_controller.estimation.identification.stage import StackIdentification
from chaserdock_controller.estimation.stage import EstimationStage
from chaserdock_controller.estimation.types import (
    Estimate,
    Estimator,
    EstimatorInputs,
    no_estimate,
)
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    OwnMotion,
    TargetEstimation,
    TargetState,
)
from chaserdock_models import rotations
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import load_scenario
from flight_cases import observation_of, scenario
from joint_cases import SyntheticFlight, navigation, odometry_in

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
ZERO = (0.0, 0.0, 0.0)


class Recorded(Estimator):
    """An estimator that keeps the odometry of each tick."""

    def __init__(self) -> None:
        self.ticks: list[tuple[list[int], list[int]]] = []

    def update(self, inputs: EstimatorInputs) -> Estimate:
        measured = [c.chaser for c in inputs.chasers if c.odometry is not None]
        self.ticks.append((measured, [c.chaser for c in inputs.chasers if c.outdated is not None]))
        return Estimate(no_estimate(inputs.time_ns))

    def estimate_at(self, time_ns: int) -> TargetState:
        return no_estimate(time_ns)


def test_estimators_get_measured_odometry_only() -> None:
    """What is extrapolated is none; odometry that arrives late is handed over with its own time."""
    flight = SyntheticFlight(scenario(), navigation("lab"), 2, 1)
    recorded = Recorded()
    stage = EstimationStage(scenario(), recorded)
    first = flight.inputs()
    flight.step()
    second = flight.inputs()
    moved = msgspec.structs.replace(odometry_in(second, 1), position_m=(9.0, 9.0, 9.0))
    for observation in (
        observation_of(
            second.time_ns,
            {0: odometry_in(second, 0), 1: moved},
            second.sightings,
            {1: odometry_in(first, 1)},
        ),
        observation_of(second.time_ns + 1, {}, (), {1: odometry_in(second, 1)}),
    ):
        stage.run(observation)
    assert recorded.ticks == [([0], [1]), ([], [1])]


def test_identification_of_the_stack_takes_measured_odometry_only() -> None:
    """An extrapolated state changes nothing, however wrong it is."""
    detumble = load_scenario(SCENARIOS / "detumble-pair.toml")
    chasers = [i for i in range(len(detumble.chasers)) if detumble.docking.port_of(i) is not None]
    motions = []
    for wrong in (False, True):
        stage, odometry = StackIdentification(detumble), {}
        for i in chasers:
            position, q = detumble.start_pose(i)
            odometry[i] = Odometry(
                tick=0, sim_time_ns=0, chaser=i, position_m=tuple(position.tolist()),
                q_wxyz=tuple(q.tolist()),
                velocity_m_s=ZERO, omega_rad_s=ZERO,
            )  # fmt: skip
        estimation = latched_estimation(frozenset(chasers), odometry)
        stage.run(observation_of(0, odometry), estimation)
        last, kept = chasers[-1], {i: odometry[i] for i in chasers[:-1]}
        moving = msgspec.structs.replace(odometry[last], velocity_m_s=(0.05, 0.0, 0.0))
        found = stage.run(
            observation_of(
                1, {**kept, last: moving} if wrong else kept, (), {last: odometry[last]}
            ),
            estimation,
        )
        assert found is not None
        motions.append([*found.motion.velocity_m_s, *found.motion.omega_rad_s])
    assert motions[0] == motions[1]


def latched_estimation(chasers: frozenset[int], own: Mapping[int, Odometry]) -> TargetEstimation:
    """Return an estimation with the target at the origin, at rest, and latched chasers."""
    target: Any = type("Target", (), {"position_m": np.zeros(3), "q_wxyz": rotations.IDENTITY})()
    estimates = tuple(
        ChaserEstimate(i, OwnMotion(own[i], np.zeros(13), np.zeros(6)), latched=i in chasers)
        for i in sorted(own)
    )
    return TargetEstimation(target, target, estimates, body=cast(Any, None))
