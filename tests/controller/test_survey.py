# SPDX-License-Identifier: Apache-2.0
"""Chasers that stay in place by their odometry while an unknown target is mapped."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    ChosenPort,
    OperatorCommand,
    PoseSolution,
    SightedMap,
    Sighting,
)
from chaserdock_protocol.scenario import Scenario
from flight_cases import odometry, scenario, tick_inputs

UNKNOWN: dict[str, Any] = {
    "perception": {"name": "features"},
    "target": {"model": "geo_servicer", "velocity_m_s": [0.0, 0.0, 0.0]},
    "limits": {"min_distance_target_m": 0.9},
    "approach": {"face_target": True, "dock_distance_m": 0.6, "max_speed_m_s": 0.05},
    "chasers": [
        {"position_m": [-2.0, 0.1, 0.0], "look_at": "target"},
        {"position_m": [-1.0, -1.7, 0.2], "look_at": "target"},
    ],
}
OMEGA = np.array([0.015, 0.045, 0.03])


class Flown:
    """Two chasers that move as commanded; the target turns at constant rates."""

    def __init__(self, **changes: Any) -> None:
        self.scenario: Scenario = scenario(**UNKNOWN, **changes)
        self.map = SightedMap(closed=True)
        self.core, self.tick = ControllerCore(self.scenario, lambda: 0.0), 0
        self.events: list[str] = []
        self.states = [np.zeros(13), np.zeros(13)]
        for i, x in enumerate(self.states):
            position, q = self.scenario.start_pose(i)
            x[:3], x[3:6], x[6:10] = position, (0.004, -0.003, 0.002), q
            x[10:] = (0.004, 0.003, -0.005)

    def sighting(self, i: int, detail: str) -> Sighting:
        time_ns = self.scenario.timing.tick_time_ns(self.tick)
        solutions: tuple[PoseSolution, ...] = ()
        if not detail:
            camera, x = self.scenario.camera_model(), self.states[i]
            lens, q_irf = camera.irf_pose_in_world(x[:3], x[6:10])
            q = rotations.exp(OMEGA * time_ns / 1e9)
            solutions = (
                PoseSolution(
                    position_m=vector(rotations.rotate_inverse(q_irf, -lens)),
                    q_wxyz=vector(rotations.multiply(rotations.conjugate(q_irf), q)),
                    covariance=vector(np.diag([1e-6] * 3 + [1e-6] * 3)),
                    reprojection_rms_px=0.5,
                ),
            )
        return Sighting(
            tick=self.tick, sim_time_ns=time_ns, chaser=i,
            status="seen" if solutions else "nothing", solutions=solutions, marker_ids=(),
            corners_px=(), rejected_ids=(), detail=detail,
            map=self.map,
        )  # fmt: skip

    def fly(
        self, ticks: int, detail: str = "", commands: tuple[OperatorCommand, ...] = ()
    ) -> TickOutputs:
        """Fly so many ticks; sightings have a pose unless ``detail`` says why not."""
        out = None
        for _ in range(ticks):
            time_ns = self.scenario.timing.tick_time_ns(self.tick)
            own = {
                i: odometry(
                    i, self.tick, time_ns, position_m=vector(x[:3]), velocity_m_s=vector(x[3:6]),
                    q_wxyz=vector(x[6:10]), omega_rad_s=vector(x[10:]),
                )
                for i, x in enumerate(self.states)
            }  # fmt: skip
            seen = tuple(self.sighting(i, detail) for i in range(2))
            out = self.core.step(tick_inputs(self.tick, time_ns, own, seen, commands))
            commands = ()
            self.events += [e.what for e in out.events]
            for i, w in out.wrenches.items():
                wrench = np.array([*w.force_N, *w.torque_N_m])
                self.states[i] = propagate(
                    self.states[i], wrench, self.scenario.chaser, 1.0 / self.scenario.time.rate_hz
                )
            self.tick += 1
        assert out is not None
        return out

    def places(self) -> Array:
        return np.array([x[:3] for x in self.states])


@pytest.mark.slow(0.05)
def test_a_survey_keeps_place_and_attitude_with_and_without_a_map() -> None:
    flown = Flown()
    flown.fly(1, "no map of the target: gathering")
    start, attitudes = flown.places(), [x[6:10].copy() for x in flown.states]
    out = flown.fly(450, "no map of the target: gathering")
    assert {w.mode for w in out.wrenches.values()} == {"track"}
    out = flown.fly(300)
    assert out.target.status == "tracking"
    assert {r.phase for r in out.references.values()} == {"survey"}
    assert np.abs(flown.places() - start).max() < 0.003
    for x, q in zip(flown.states, attitudes, strict=True):
        assert rotations.angle_between(x[6:10], q) < np.deg2rad(0.2)
    assert not any("searching" in e or "hold" in e for e in flown.events)


def test_references_of_a_survey_are_where_the_chasers_are() -> None:
    flown = Flown()
    out = flown.fly(120)
    for i, reference in out.references.items():
        assert np.linalg.norm(np.array(reference.position_m) - flown.states[i][:3]) < 0.01
        turned = rotations.angle_between(reference.q_wxyz, flown.states[i][6:10])
        assert turned < np.deg2rad(0.5)


@pytest.mark.parametrize("reason", ["no map of the target: does not turn", "no distances: x"])
def test_without_a_pose_commands_are_refused_by_the_named_reason(reason: str) -> None:
    flown = Flown()
    flown.fly(30, reason)
    there = OperatorCommand(command="goto", chaser=0, offset_m=(-1.2, 0.0, 0.0))
    (reply,) = flown.fly(1, reason, (there,)).replies
    assert (reply.accepted, reply.reason) == (False, reason)
    flown.fly(60)
    (reply,) = flown.fly(1, "", (there,)).replies
    assert reply.accepted


def test_only_goto_leads_out_of_a_survey() -> None:
    flown = Flown()
    flown.fly(60)
    for name in ("approach", "inspect", "calibrate", "retreat", "hold", "abort"):
        (reply,) = flown.fly(1, "", (OperatorCommand(command=name, chaser=0),)).replies
        assert not reply.accepted
        assert reply.reason.startswith("in phase survey")


@pytest.mark.slow(0.05)
def test_a_chaser_flies_to_its_place_and_turns_with_the_target() -> None:
    flown = Flown()
    flown.fly(60)
    offset = (-1.4, 0.1, 0.0)
    (reply,) = flown.fly(
        1, "", (OperatorCommand(command="goto", chaser=0, offset_m=offset),)
    ).replies
    assert reply.accepted
    out = flown.fly(600)
    assert out.references[0].phase == "hold"
    q = rotations.exp(OMEGA * (flown.tick - 1) / 15.0)
    at = rotations.rotate_inverse(q, flown.states[0][:3])
    assert np.linalg.norm(at - offset) < 0.02
    assert np.linalg.norm(flown.states[1][:3] - flown.scenario.start_pose(1)[0]) < 0.01


THERE = OperatorCommand(command="goto", chaser=0, offset_m=(-1.2, 0.0, 0.0))
TO_PORT = OperatorCommand(command="goto", chaser=0)
APPROACH = OperatorCommand(command="approach", chaser=0)


def port(number: int = 1, shift_m: float = 0.0) -> ChosenPort:
    """A port beside the middle of the target, whose axis does not meet that."""
    axis = np.array([-0.93, 0.2, 0.25])
    return ChosenPort(
        chaser=0, number=number, position_m=(-0.3, 0.15 + shift_m, -0.1),
        axis=vector(axis / np.linalg.norm(axis)), axis_sigma_rad=0.01, flatness_m=0.002,
        clearance_m=0.3,
    )  # fmt: skip


def pose_in_target(flown: Flown) -> tuple[Array, Array]:
    """Return centre and direction of +X of chaser 0 in TRF."""
    q = rotations.exp(OMEGA * (flown.tick - 1) / 15.0)
    x = flown.states[0]
    forward = rotations.rotate(x[6:10], [1.0, 0.0, 0.0])
    return rotations.rotate_inverse(q, x[:3]), rotations.rotate_inverse(q, forward)


def test_nothing_flies_near_by_a_map_whose_loop_is_open() -> None:
    flown = Flown()
    flown.map = SightedMap(closed=False)
    flown.fly(60)
    (reply,) = flown.fly(1, "", (THERE,)).replies
    assert not reply.accepted
    assert reply.reason.startswith("the loop of the map is open")
    farther = OperatorCommand(command="goto", chaser=0, offset_m=(-2.2, 0.1, 0.0))
    (reply,) = flown.fly(1, "", (farther,)).replies
    assert reply.accepted
    flown.fly(30)
    (reply,) = flown.fly(1, "", (APPROACH,)).replies
    assert reply.reason.startswith("the loop of the map is open")
    flown.map = SightedMap(closed=True)
    flown.fly(1)
    (reply,) = flown.fly(1, "", (THERE,)).replies
    assert reply.accepted


def test_a_goto_without_an_offset_needs_a_port() -> None:
    flown = Flown()
    flown.fly(60)
    (reply,) = flown.fly(1, "", (TO_PORT,)).replies
    assert (reply.accepted, reply.reason) == (False, "goto needs an offset")


@pytest.mark.slow(0.1)
def test_a_chaser_docks_at_its_port_and_follows_it() -> None:
    flown = Flown()
    flown.map = SightedMap(closed=True, port=port())
    flown.fly(60)
    (reply,) = flown.fly(1, "", (TO_PORT,)).replies
    assert reply.accepted, reply.reason
    assert flown.fly(900).references[0].phase == "hold"
    axis, base = np.array(port().axis), np.array(port().position_m)
    place, forward = pose_in_target(flown)
    assert np.linalg.norm(place) == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(np.cross(place - base, axis)) < 0.02
    assert np.degrees(np.arccos(forward @ -axis)) < 1.0
    (reply,) = flown.fly(1, "", (APPROACH,)).replies
    assert reply.accepted, reply.reason
    assert flown.fly(300).references[0].phase == "docked"
    place, forward = pose_in_target(flown)
    assert np.linalg.norm(place - base - 0.6 * axis) < 0.01
    assert np.degrees(np.arccos(forward @ -axis)) < 0.5
    # The next map has it 6 mm aside; another choice does not count before the next goto.
    flown.map = SightedMap(closed=True, port=port(1, 0.006))
    out = flown.fly(150)
    assert out.references[0].phase == "docked"
    assert np.linalg.norm(out.references[0].offset_m - base - 0.6 * axis - [0, 0.006, 0]) < 1e-6
    flown.map = SightedMap(closed=True, port=port(2, 0.1))
    again = flown.fly(150)
    assert again.references[0].offset_m == out.references[0].offset_m
    # A mapper that begins again has no port: where the frame is now, nobody knows.
    flown.map = SightedMap(closed=True)
    assert flown.fly(2).references[0].phase == "hold"
    assert any("docked: the map has lost its port" in e for e in flown.events)
    (reply,) = flown.fly(1, "", (APPROACH,)).replies
    assert "beside the approach line" in reply.reason


def test_the_way_to_a_port_must_not_lead_past_the_target() -> None:
    flown = Flown()
    behind = msgspec.structs.replace(port(), position_m=(0.3, 0.1, 0.0), axis=(1.0, 0.0, 0.0))
    flown.map = SightedMap(closed=True, port=behind)
    flown.fly(60)
    (reply,) = flown.fly(1, "", (TO_PORT,)).replies
    assert not reply.accepted
    assert "of the middle of the target" in reply.reason


@pytest.mark.slow(0.1)
def test_the_timeline_waits_for_map_and_port_and_the_way_there() -> None:
    flown = Flown(
        timeline=[
            {"at_s": 1.0, "command": "port", "chasers": [0], "port": {"find": "flat"}},
            {"at_s": 2.0, "command": "goto", "chasers": [0]},
            {"at_s": 2.0, "command": "approach", "chasers": [0]},
        ]
    )
    flown.map = SightedMap(closed=False)
    flown.fly(75)
    flown.map = SightedMap(closed=True)
    assert flown.fly(75).references[0].phase == "survey"
    assert not any("goto" in e for e in flown.events)
    # What a standby would begin with: all but the port, which is the mapper's.
    assert flown.core.guidance.fleet.left == [1, 2]
    behind = msgspec.structs.replace(port(), position_m=(0.3, 0.1, 0.0), axis=(1.0, 0.0, 0.0))
    flown.map = SightedMap(closed=True, port=behind)
    assert flown.fly(30).references[0].phase == "survey"
    flown.map = SightedMap(closed=True, port=port(2))
    assert flown.fly(2).references[0].phase == "goto"
    assert flown.core.guidance.fleet.left == [2]
    flown.fly(1100)
    assert flown.core.guidance.fleet.left == []
    assert flown.fly(1).references[0].phase == "docked"
