# SPDX-License-Identifier: Apache-2.0
"""Invalid input to the controller: one clear error before the flight; in flight an event and a safe
command.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.ingest.sighting_validation import valid_sightings
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_protocol import codec
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import (
    Odometry,
    OperatorCommand,
    PoseSolution,
    Sighting,
    encoding_of,
)
from chaserdock_protocol.scenario import Scenario, ScenarioError, parse_scenario
from flight_cases import odometry, scenario, tick_inputs

from chaserdock.experiments.perfect_knowledge import PerfectEstimator

AT_START = [
    ({"controller": {"weight_position": -65.0}}, "controller.weight_position: "),
    ({"controller": {"weight_orientation": -35.0}}, "controller.weight_orientation: "),
    ({"controller": {"weight_force": -3.5}}, "controller.weight_force: "),
    ({"controller": {"weight_torque": 0.0}}, "controller.weight_torque: "),
    ({"controller": {"weight_final_position": -1.0}}, "controller.weight_final_position: "),
    ({"controller": {"weight_final_orientation": -1.0}}, "controller.weight_final_orientation: "),
    ({"controller": {"horizon_s": 0.04}}, "shorter than one step dt_s"),
    ({"controller": {"falloff": 1.1}}, "controller.falloff: "),
    ({"chaser": {"mass_kg": 0.0}}, "chaser.mass_kg: "),
    ({"chaser": {"inertia_kg_m2": [0.1, 0.1, 0.0]}}, "chaser.inertia_kg_m2"),
    (
        {"limits": {"min_distance_target_m": 1.1}},
        "chasers.0.position_m: 1 m from the target, nearer than",
    ),
    (
        {"limits": {"min_distance_chasers_m": 1.6}},
        "the positions of chasers.0 and chasers.1 are 1.56 m apart, nearer than",
    ),
    (
        {"limits": {"max_reference_distance_m": 0.9}},
        "chasers.0.position_m: 1 m from the target, farther than",
    ),
]


@pytest.mark.parametrize(("changes", "message"), AT_START)
def test_infeasible_scenario_gives_one_error_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError) as error:
        scenario(**changes)
    (line,) = str(error.value).splitlines()
    assert line.startswith("test: ")
    assert message in line


def test_quaternion_of_wrong_length_is_a_scenario_error() -> None:
    chasers = [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [0.9, 0.0, 0.0, 0.0]}]
    with pytest.raises(ScenarioError, match=r"test: chasers.0.q_wxyz: .*unit"):
        parse_scenario({"name": "x", "duration_s": 1.0, "chasers": chasers}, "test")


def test_start_inside_keep_out_is_allowed() -> None:
    """The flight begins by leaving the keep-out sphere."""
    near = {
        "start_offset_m": [0.75, 0.0, 0.0],
        "position_m": [-1.0, 0.0, 0.0],
        "q_wxyz": [1.0, 0.0, 0.0, 0.0],
    }
    assert nmpc_parameters(scenario(chasers=[near])).stages == 30


def core_of(mission: Scenario) -> ControllerCore:
    return ControllerCore(mission, lambda: 0.0, PerfectEstimator(mission.target))


def step(
    flight: ControllerCore, tick: int, *commands: OperatorCommand, **changes: Any
) -> TickOutputs:
    """Step with the given odometry of chaser 0 and chaser 1 at its reference."""
    now_ns = flight.scenario.timing.tick_time_ns(tick)
    here = {
        0: odometry(
            0,
            tick,
            now_ns,
            **({"position_m": (-1.0, 0.0, 0.0), "velocity_m_s": (0.0,) * 3} | changes),
        ),
        1: odometry(1, tick, now_ns, position_m=(0.0, -1.2, 0.0), velocity_m_s=(0.0,) * 3),
    }
    return flight.step(tick_inputs(tick, now_ns, here, (), commands))


INVALID = [
    ({"position_m": (float("nan"), 0.0, 0.0)}, "position_m holds a value that is not finite"),
    ({"velocity_m_s": (0.0, float("inf"), 0.0)}, "velocity_m_s holds a value that is not finite"),
    ({"omega_rad_s": (0.0, 0.0, float("nan"))}, "omega_rad_s holds a value that is not finite"),
    ({"position_covariance_m2": (float("nan"),) * 9}, "position_covariance_m2 is not a covariance"),
    ({"q_wxyz": (0.0, 0.0, 0.0, 0.0)}, "q_wxyz has length 0, not 1"),
    ({"q_wxyz": (0.8, 0.0, 0.0, 0.0)}, "q_wxyz has length 0.8, not 1"),
]
# Receivers check variances only.
INVALID_COVARIANCES: list[tuple[dict[str, Any], str]] = [
    (
        {"attitude_covariance_rad2": (1.0, 0.5, *(0.0,) * 7)},
        "attitude_covariance_rad2 is not a covariance",
    ),
    (
        {"velocity_covariance_m2_s2": (1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0)},
        "velocity_covariance_m2_s2 is not a covariance",
    ),
]


@pytest.mark.parametrize(("changes", "message"), [*INVALID, *INVALID_COVARIANCES])
def test_invalid_odometry_makes_only_that_chaser_coast(
    changes: dict[str, Any], message: str
) -> None:
    """The codec already rejects most of these messages (below); the core is safe without it."""
    flight = core_of(scenario())
    assert step(flight, 0).wrenches[0].mode == "nmpc"
    for tick in (1, 2):
        out = step(flight, tick, **changes)
        errors = [e.what for e in out.events if e.level == "error"]
        assert errors == ([f"chaser 0: invalid odometry, coasting: {message}"] if tick == 1 else [])
        assert out.wrenches[0].mode == "coast"
        assert not any([*out.wrenches[0].force_N, *out.wrenches[0].torque_N_m])
        assert out.wrenches[1].mode == "nmpc"
        assert out.solver is not None
        assert out.solver.chasers == (1,)
        assert out.target.status == "tracking"
    again = step(flight, 3)
    assert again.wrenches[0].mode == again.wrenches[1].mode == "nmpc"
    assert "chaser 0: planned again" in [e.what for e in again.events]


def test_all_chasers_coast_without_valid_odometry() -> None:
    flight = core_of(scenario())
    invalid = {i: odometry(i, 0, 0, q_wxyz=(0.0,) * 4) for i in (0, 1)}
    out = flight.step(tick_inputs(0, 0, invalid, ()))
    assert [out.wrenches[i].mode for i in (0, 1)] == ["coast", "coast"]


@pytest.mark.parametrize("changes", [c for c, _ in INVALID])
def test_codec_rejects_invalid_odometry(changes: dict[str, Any]) -> None:
    payload = codec.encode(odometry(0, **changes))
    with pytest.raises(Rejected):
        codec.decode(Odometry, payload, encoding_of(Odometry))


def test_unreachable_goto_is_rejected_with_reason() -> None:
    flight = core_of(scenario())
    step(flight, 0)
    for offset, message in (
        ((30.0, 0.0, 0.0), "30 m from the target"),
        ((0.1, 0.0, 0.0), "0.1 m from the target"),
    ):
        out = step(flight, 1, OperatorCommand(command="goto", chaser=0, offset_m=offset))
        (reply,) = out.replies
        assert not reply.accepted
        assert message in reply.reason
        assert out.wrenches[0].mode == "nmpc"
        assert out.references[0].phase == "hold"


def solution(**changes: Any) -> PoseSolution:
    covariance = tuple((1e-6 * np.eye(6)).ravel().tolist())
    values = {
        "position_m": (0.0, 0.0, 1.0),
        "q_wxyz": (1.0, 0.0, 0.0, 0.0),
        "covariance": covariance,
    }
    return PoseSolution(**{**values, "reprojection_rms_px": 0.1, **changes})  # type: ignore[arg-type]


def covariance(row: int, column: int, value: float) -> tuple[float, ...]:
    matrix = 1e-6 * np.eye(6)
    matrix[row, column] = value
    return tuple(matrix.ravel().tolist())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, ""),
        ({"covariance": covariance(2, 2, -1e-6)}, "covariance is not positive definite"),
        ({"covariance": covariance(0, 1, 1e-7)}, "covariance is not symmetric"),
        ({"q_wxyz": (0.0, 0.0, 0.0, 0.0)}, "q_wxyz has length 0, not 1"),
    ],
)
def test_invalid_solutions_of_a_sighting_are_dropped_with_an_event(
    changes: dict[str, Any], reason: str
) -> None:
    sample = Sighting(
        chaser=2,
        status="seen",
        solutions=(solution(**changes), solution()),
        marker_ids=(1,),
        corners_px=(),
        rejected_ids=(),
    )
    (checked,), events = valid_sightings([sample])
    assert checked.solutions == (sample.solutions if not reason else sample.solutions[1:])
    assert events == (
        [("warning", f"chaser 2: invalid sighting, ignored: {reason}")] if reason else []
    )
