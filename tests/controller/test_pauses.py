# SPDX-License-Identifier: Apache-2.0
"""After a pause, as when robots were disarmed, every kind of motion begins again where the chaser
is and points, in general position: a target that tumbles and drifts on, chasers at rest meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance.chaser_machine import ChaserMachine
from chaserdock_controller.guidance.chaser_state import ChaserGuidance, NextMove
from chaserdock_controller.guidance.horizon import ReferenceBuilder
from chaserdock_controller.guidance.pauses import resume_after_pause
from chaserdock_controller.guidance.phases import Phase, Trigger
from chaserdock_controller.guidance.pointing import SearchProgress, calibration_turns
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.guidance.trajectories import PEAK_SPEED, Slew, stay
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    ChaserObservation,
    GuidanceResult,
    Observation,
    OwnMotion,
    PlanningFailure,
    TargetEstimation,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import FlightScenario, load_scenario
from chaserdock_protocol.scenario.flight import flight_scenario
from docking_cases import Pilot, senses
from flight_cases import at, drain, fleet_of, known, odometry, scenario, step
from general_position import BODY, attitude, matrix, moving_odometry, target_state
from harness import ROOT
from msgspec.structs import replace as replace_struct

HZ, PAUSE_S = 15, 8.0
PLACES = ((-1.0, 0.3, 0.5), (0.9, -0.8, 0.4), (0.2, 1.6, -0.9))
SPEED_M_S, INSPECT_M_S = 0.03, 0.08
"""``approach.max_speed_m_s`` of the mission: retreats and approaches keep it, other moves twice
it.
"""


class _NoFailures:
    def failure(self, chaser: int, time_ns: int) -> PlanningFailure | None:
        return None

    def unsafe(self, chaser: int, time_ns: int) -> str:
        return ""


class Flight:
    """Guidance of chasers that are where their references are, but at rest in pauses, and point
    anywhere. ``tick``: the newest one; ``places``: of the chasers then, WRF.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.scenario: FlightScenario = scenario(
            chasers=[{"position_m": list(p), "q_wxyz": attitude(rng).tolist()} for p in PLACES],
            inspection={"axis": rng.normal(size=3).tolist(), "distance_m": 1.5},
        )
        self.stage, self.tick, self.places = GuidanceStage(self.scenario), -1, list(PLACES)
        self._start, self._rested = target_state(rng, 0), False

    @property
    def now_s(self) -> float:
        return self.tick / HZ

    @property
    def chaser(self) -> ChaserMachine:
        return self.stage.chasers[0]

    def target(self) -> tuple[Array, Array]:
        """Return position and attitude of the target, which turns steadily."""
        s, t = self._start, self.now_s
        q = rotations.multiply(s.q_wxyz, rotations.exp(t * s.omega_rad_s))
        return s.position_m + t * s.velocity_m_s, q

    def in_target(self, place_m: Any) -> Array:
        p, q = self.target()
        return matrix(q).T @ (place_m - p)

    def pause(self) -> None:
        """Let time go on without ticks."""
        self.tick += round(PAUSE_S * HZ)
        self._rested = True

    def fly(self, *commands: OperatorCommand, ticks: int = 1) -> GuidanceResult:
        """Fly some ticks, the first with commands."""
        for _ in range(ticks - 1):
            self._fly(commands)
            commands = ()
        return self._fly(commands)

    def _fly(self, commands: Sequence[OperatorCommand]) -> GuidanceResult:
        self.tick += 1
        p, q = self.target()
        if not self._rested:
            moves = [c.state.move for c in self.stage.chasers]
            self.places = [p + matrix(q) @ at(move, self.now_s)[0] for move in moves]
        self._rested = False
        own = [moving_odometry(np.random.default_rng(i), i, 0, 0) for i in range(len(PLACES))]
        own = [
            replace_struct(o, position_m=vector(place))
            for o, place in zip(own, self.places, strict=True)
        ]
        time_ns = round(self.now_s * 1e9)
        seen = tuple(ChaserObservation(o.chaser, np.ones(6), o) for o in own)
        target = replace(self._start, time_ns=time_ns, position_m=p, q_wxyz=q)
        estimates = [ChaserEstimate(o.chaser, OwnMotion(o, np.zeros(13), np.zeros(6))) for o in own]
        return self.stage.run(
            Observation(self.tick, time_ns, time_ns, seen, commands=tuple(commands)),
            TargetEstimation(target, target, tuple(estimates), BODY),
            _NoFailures(),
        )

    def attitude(self) -> Array:
        """Return the attitude of the first chaser, WRF."""
        return np.array(moving_odometry(np.random.default_rng(0), 0, 0, 0).q_wxyz)

    def fly_into(self, phase: str) -> None:
        """Fly the first chaser into a phase."""
        *before, last = KINDS[phase][0] or (None,)
        self.fly(ticks=3)
        for one in before:
            self.fly(one, ticks=150)
        self.fly(*([last] if last else []), ticks=20)
        assert self.chaser.phase == phase

    def turns_left(self, times_s: Array) -> Array:
        """Return the angles of the first chaser's reference from that without a pause."""
        chaser, state = self.chaser, self.chaser.state
        found = []
        for t in times_s.tolist():
            chaser.state = state
            _, q, _ = self.stage.references.pose(chaser, self._start, t)
            chaser.state = replace(state, slew=None)
            _, q_without, _ = self.stage.references.pose(chaser, self._start, t)
            found.append(float(rotations.angle_between(q, q_without)))
        chaser.state = state
        return np.array(found)


def command(what: Any, offset: Any = None) -> OperatorCommand:
    return OperatorCommand(command=what, chaser=0, offset_m=offset)


KINDS: dict[str, tuple[tuple[OperatorCommand, ...], float]] = {
    "hold": ((), 2.0 * SPEED_M_S),
    "goto": ((command("goto", (-2.1, 1.3, 0.9)),), 2.0 * SPEED_M_S),
    "approach": ((command("approach"),), SPEED_M_S),
    "retreat": ((command("approach"), command("retreat")), SPEED_M_S),
    "abort": ((command("approach"), command("abort")), 2.0 * SPEED_M_S),
    "inspect": ((command("inspect"),), INSPECT_M_S),
}
"""Commands that lead to each phase, and the largest speed of the reference in it, m/s."""


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("phase", KINDS)
def test_motion_begins_again_where_the_chaser_is(phase: str, seed: int) -> None:
    flight, (_, limit_m_s) = Flight(seed), KINDS[phase]
    flight.fly_into(phase)
    chaser = flight.chaser
    before, in_phase_s = chaser.state, flight.now_s - chaser.state.since_s
    flight.pause()
    result = flight.fly()
    state, now_s, here_m = chaser.state, flight.now_s, flight.in_target(flight.places[0])
    assert before.phase == state.phase == phase
    assert np.linalg.norm(here_m - at(before.move, now_s)[0]) > 0.1  # that has gone on
    reference = result.directives[0].reference
    assert reference is not None
    np.testing.assert_allclose(reference.position_m, flight.places[0], atol=1e-9)
    times_s = now_s + np.arange(0.0, 500.0, 0.05)
    path_m = state.move.at(times_s)[0]
    np.testing.assert_allclose(path_m[0], here_m, atol=1e-9)
    assert np.linalg.norm(np.diff(path_m, axis=0), axis=1).max() / 0.05 < 1.01 * limit_m_s
    if phase != "inspect":
        np.testing.assert_allclose(path_m[-1], before.move.goal_m, atol=1e-9)
    assert now_s - state.since_s == pytest.approx(in_phase_s)  # it stands still in the pause
    warned = [text for _, text in result.events if "where it is" in text]
    assert len(warned) == len(PLACES)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("phase", KINDS)
def test_attitude_begins_again_where_the_chaser_points(phase: str, seed: int) -> None:
    flight, (_, limit_m_s) = Flight(seed), KINDS[phase]
    flight.fly_into(phase)
    flight.pause()
    result = flight.fly()
    now_s, here_m = flight.now_s, flight.in_target(flight.places[0])
    reference, horizon = result.directives[0].reference, result.horizon
    assert reference is not None
    assert horizon is not None
    assert rotations.angle_between(reference.q_wxyz, flight.attitude()) < 1e-7
    assert rotations.angle_between(horizon.references[0, 0, 3:], flight.attitude()) < 1e-7
    limit_rad_s = limit_m_s / float(np.linalg.norm(here_m))
    turn_rad = flight.turns_left(np.array([now_s]))[0]
    assert turn_rad > 0.5
    lasts_s = PEAK_SPEED * turn_rad / limit_rad_s
    left_rad = flight.turns_left(now_s + np.linspace(0.0, 1.05 * lasts_s, 800))
    rates = -np.diff(left_rad) / (1.05 * lasts_s / 799)
    assert rates.min() > -1e-6
    assert 0.99 * limit_rad_s < rates.max() < 1.001 * limit_rad_s
    assert rates[0] < 0.01 * limit_rad_s  # from rest
    assert left_rad[-1] < 1e-9


def test_turn_goes_on_through_commands_and_begins_again_in_the_next_pause() -> None:
    flight = Flight(0)
    flight.fly_into("hold")
    flight.pause()
    flight.fly(ticks=100)
    soon_s = np.array([flight.now_s + 1.0 / HZ])
    before = flight.turns_left(soon_s)
    flight.fly(command("retreat"))
    assert flight.chaser.phase == "retreat"
    np.testing.assert_allclose(flight.turns_left(soon_s), before, atol=1e-9)
    flight.pause()
    reference = flight.fly().directives[0].reference
    assert reference is not None
    assert rotations.angle_between(reference.q_wxyz, flight.attitude()) < 1e-7


def test_chaser_that_turns_is_not_docked() -> None:
    (chaser, _) = fleet_of(scenario(), 0.0).chasers
    turn = Slew(1.0, np.array([0.1, -0.2, 0.3]), 20.0)
    chaser.state = ChaserGuidance(Phase.APPROACH, 0.0, stay([0.3, 0.2, -0.1], 0.0), slew=turn)
    for now_s, phase in (
        (2.0, "approach"),
        (20.9, "approach"),
        (21.1, "approach"),
        (40.0, "docked"),
    ):
        step(chaser, now_s)
        assert chaser.phase == phase


def test_chaser_on_a_floor_turns_about_its_vertical_only() -> None:
    flown = flight_scenario(load_scenario(ROOT / "scenarios" / "planar-docking.toml"))
    fleet, builder = fleet_of(flown, 0.0), ReferenceBuilder(flown)
    chaser = fleet.chasers[0]
    leaning = rotations.exp([0.01, -0.02, 0.9])
    q = rotations.multiply(builder.pose(chaser, known(0.0).target, 9.0)[1], leaning)
    chaser.led_s = 1.0
    tick = known(9.0, own=odometry(q_wxyz=vector(q)), offset_m=np.array([0.4, 1.1, 0.0]))
    resume_after_pause(chaser, tick, fleet.moves, builder)
    assert chaser.state.slew is not None
    np.testing.assert_allclose(chaser.state.slew.turn_rad, [0.0, 0.0, 0.9], atol=1e-3)
    assert chaser.state.slew.turn_rad[0] == chaser.state.slew.turn_rad[1] == 0.0


def test_motion_goes_on_after_a_gap_within_the_life_of_commands() -> None:
    flight = Flight(0)
    flight.fly(ticks=3)
    flight.fly(command("goto", (-2.1, 1.3, 0.9)), ticks=20)
    before = flight.chaser.state
    flight.tick += int(flight.scenario.controller.command_lifetime_s * HZ) - 1
    flight.fly()
    assert flight.chaser.state is before


def test_calibration_goes_on_where_it_was() -> None:
    flight = Flight(1)
    flight.fly(ticks=3)
    flight.chaser.fire(Trigger.COMMAND_CALIBRATE, flight.now_s)
    flight.fly(ticks=90)
    turned = calibration_turns(flight.now_s - flight.chaser.state.since_s)
    flight.pause()
    flight.fly()
    again = calibration_turns(flight.now_s - flight.chaser.state.since_s)
    assert flight.chaser.phase == "calibrate"
    np.testing.assert_allclose(again, turned, atol=1e-9)


@pytest.mark.parametrize("phase", ["approach", "final", "contact"])
def test_way_into_a_port_begins_again_from_before_the_corridor(phase: str) -> None:
    pilot = Pilot()
    assert pilot.ask("approach")[0]
    pilot.fly_to(phase)
    (chaser,), now_s = pilot.guidance.chasers, pilot.now_s + PAUSE_S
    chaser.led_s = pilot.now_s
    here_m = at(chaser.state.move, pilot.now_s)[0] + np.array([0.01, -0.02, 0.015])
    tick = known(now_s, offset_m=here_m, port=senses(here_m))
    builder = ReferenceBuilder(chaser.scenario)
    resume_after_pause(chaser, tick, pilot.guidance.moves, builder)
    assert (chaser.phase, chaser.state.then) == ("retreat", NextMove.ATTEMPT)
    assert tick.own is not None
    _, q, _ = builder.pose(chaser, tick.target, now_s)
    assert rotations.angle_between(q, tick.own.q_wxyz) < 1e-7
    np.testing.assert_allclose(at(chaser.state.move, now_s)[0], here_m)
    assert "not led for 8.0 s" in drain(pilot.guidance)[-1][2]


def test_latched_chaser_keeps_its_place_and_the_time_of_its_test() -> None:
    pilot = Pilot()
    assert pilot.ask("approach")[0]
    pilot.fly_to("latched")
    pilot.fly(0.4)
    (chaser,), now_s = pilot.guidance.chasers, pilot.now_s + PAUSE_S
    chaser.led_s, before, in_phase_s = pilot.now_s, chaser.state, pilot.now_s - chaser.state.since_s
    tick = known(now_s, offset_m=np.ones(3), port=senses(np.ones(3), latched=True))
    resume_after_pause(chaser, tick, pilot.guidance.moves, ReferenceBuilder(chaser.scenario))
    assert (chaser.phase, chaser.state.move) == ("latched", before.move)
    assert now_s - chaser.state.since_s == pytest.approx(in_phase_s)


def test_search_goes_on_where_it_was() -> None:
    progress = SearchProgress(np.array([0.5, -0.5, 0.1, 0.7]), 3.0, paused_s=1.5)
    later = progress.taken_up(11.0)
    assert (later.updated_s, later.paused_s) == (11.0, 9.5)
    assert 11.0 - later.paused_s == 3.0 - progress.paused_s
