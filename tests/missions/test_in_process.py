# SPDX-License-Identifier: Apache-2.0
"""The in-process mission equals a lock-step mission in separate processes, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol import topics
from chaserdock_protocol.messages import Sighting
from chaserdock_protocol.scenario import load_scenario, parse_scenario
from chaserdock_world.rendering.cameras import States
from flights.measured_poses import measurement_model
from harness import ROOT, SHORT

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages
from chaserdock.logs import open_log
from chaserdock.simulation.mission import simulate

SMALL = (
    "camera.width_px=480",
    "camera.height_px=270",
    "settling_s=1.0",
    "success.steady_position_rms_m=9.0",
    "success.steady_orientation_rms_deg=180.0",
    "success.max_estimate_position_m=9.0",
)
NAVIGATION = "navigation={grade='orbit',position_bias_m=0.002}"
ERRORS = (
    *SMALL,
    "duration_s=3.0",
    "chaser.actuation='thrusters'",
    "chaser.body='tetra12'",
    "thruster_failure=[{chaser=0,thruster=4,at_s=0.5,kind='stuck_on'}]",
    "camera.effects={read_noise=3.0,jpeg_quality=80}",
    NAVIGATION,
)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [SHORT, ERRORS], ids=["ideal", "errors"])
def test_truth_equals_lockstep_mission(
    overrides: tuple[str, ...], shared_flight: Callable[..., Path], tmp_path: Path
) -> None:
    path = ROOT / "scenarios" / "two-chaser-tracking.toml"
    if overrides is SHORT:
        folder = shared_flight("short", path.stem, *overrides)
    else:  # as separate processes fly it, bit for bit (test_simulation.py)
        folder = tmp_path
        simulate(path, folder, overrides)
    log = open_log(folder)
    logged = {(m.body, m.tick): m for m in (r.message for r in log.records(topics.TRUTH_BODY))}
    scenario = load_scenario(path, overrides)
    assert len(logged) == 3 * (scenario.ticks + 1)
    with InProcessMission(scenario, RenderedImages(scenario)) as mission:
        for record in mission.ticks():
            for body, state in record.states.items():
                message = logged[body, record.tick]
                for field in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
                    logged_value = np.array(getattr(message, field))
                    np.testing.assert_array_equal(
                        getattr(state, field), logged_value, f"{body} {record.tick} {field}"
                    )
            for i, delivered in record.delivered.items():
                message = logged[f"chaser/{i}", record.tick + 1]
                assert delivered.thruster_impulse_N_s == message.thruster_impulse_N_s
                np.testing.assert_array_equal(delivered.impulse[:3], message.impulse_N_s)


def mission(**changes: object) -> dict[str, object]:
    still = {"motion": "static"}
    chasers = [{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}]
    return {
        "name": "test",
        "duration_s": 2.0,
        "navigation": {"grade": "exact"},
        "target": still,
        "chasers": chasers,
    } | changes


@pytest.mark.parametrize("perception", ["model", "default"])
def test_chaser_that_does_not_see_a_target_without_markers_gets_its_expected_pose(
    perception: str,
) -> None:
    changes = (
        *SMALL,
        "duration_s=3.0",
        "navigation={grade='exact'}",
        f"perception.name='{perception}'",
    )
    scenario = load_scenario(ROOT / "scenarios/two-chaser-tracking.toml", changes)
    measured, camera = measurement_model(scenario, 1), scenario.camera_model()

    def seen_by_0_only(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        sighting = measured(chaser, tick, time_ns, states)
        return (
            sighting
            if chaser == 0
            else msgspec.structs.replace(sighting, status="nothing", solutions=())
        )

    expected, compared = None, 0
    with InProcessMission(scenario, seen_by_0_only) as mission:
        for record in mission.ticks():
            assert record.outputs is not None
            if expected is not None and record.time_s > 1.0:
                assert abs(expected.sim_time_ns - record.time_ns) <= 1
                own, target = record.states["chaser/1"], record.states["target"]
                lens, axes = camera.irf_pose_in_world(own.position_m, own.q_wxyz)
                at = rotations.rotate_inverse(axes, target.position_m - lens)
                q = rotations.multiply(rotations.conjugate(axes), target.q_wxyz)
                np.testing.assert_allclose(expected.position_m, at, atol=0.002)
                assert rotations.angle_between(np.array(expected.q_wxyz), q) < np.radians(0.2)
                compared += 1
            assert record.outputs.wrenches[0].expected is None or record.time_s < 0.2
            expected = record.outputs.wrenches[1].expected
    assert compared > 20 if perception == "model" else expected is None and compared == 0


def test_odometry_errors_of_the_scenario_apply() -> None:
    scenario = parse_scenario(
        mission(
            navigation={"grade": "exact", "position_bias_m": 0.01, "velocity_noise_m_s": 0.001}
        ),
        "test",
    )
    with InProcessMission(scenario) as flight:
        records = list(flight.ticks())
    offsets = [
        np.array(r.odometry[0].position_m) - r.states["chaser/0"].position_m for r in records
    ]
    assert np.linalg.norm(offsets[0]) > 1e-3
    np.testing.assert_allclose(offsets, np.tile(offsets[0], (len(offsets), 1)), atol=1e-12)
    assert (
        np.std(
            [r.odometry[0].velocity_m_s[0] - r.states["chaser/0"].velocity_m_s[0] for r in records]
        )
        > 5e-4
    )


def test_equal_seeds_give_equal_flights() -> None:
    scenario = parse_scenario(mission(), "test")
    ends = []
    for _ in range(2):
        with InProcessMission(
            scenario, measurement_model(scenario, 1, 0.002, 0.002, dropout=0.1)
        ) as flight:
            records = list(flight.ticks())
            ends.append(flight.states()["chaser/0"].position_m)
            assert {len(r.sightings[0].solutions) for r in records} == {0, 1}
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("option", [{"actuator_gain": 1.05}, {"solve_delay_s": lambda _: 0.1}])
def test_gain_and_delay_are_rejected_with_thrusters(option: dict) -> None:
    chaser = {"body": "tetra12", "actuation": "thrusters"}
    with pytest.raises(ValueError, match=r"need chaser\.actuation"):
        InProcessMission(parse_scenario(mission(chaser=chaser), "test"), **option)
