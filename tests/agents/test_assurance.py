# SPDX-License-Identifier: Apache-2.0
"""Assurance of commands: conditions, the nearest input, and flights under harmful commands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.assurance.assurance import Assurance
from chaserdock_agents.chaser.assurance.barriers import (
    RECOVERY_M_S,
    SETTLING_S,
    Barrier,
    Margin,
    OffsetEstimate,
    PortCorridor,
    distance_barriers,
    stopping_speed,
)
from chaserdock_agents.chaser.assurance.nearest_input import Conditions, nearest_input
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_models import rotations
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import AssuranceStatus
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from flights.assured import ATTACKS, AssuredFlight, Attack

BRAKING, INTERVAL = 0.04, 0.1
EXACT = np.zeros((3, 3))
NO_MARGIN = Margin(3.0, 0.1, 0.01)


def assured(folder: Path, name: str, *overrides: str) -> Scenario:
    file = folder / "assured.toml"
    file.write_text(f'extends = "{name}"\nname = "assured"\n[assurance]\n')
    return load_scenario(file, overrides)


# -- conditions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [-0.05, -0.011, 0.0, 0.02])
@pytest.mark.parametrize("room", [0.001, 0.03, 0.4])
def test_the_least_acceleration_leaves_just_enough_room_to_stop(room: float, rate: float) -> None:
    least = Barrier("target", np.array([1.0, 0.0, 0.0]), room, rate).least_acceleration(
        BRAKING, INTERVAL
    )
    after = room + rate * INTERVAL + 0.5 * least * INTERVAL**2
    speed = -(rate + least * INTERVAL)
    if room + rate * INTERVAL / 2.0 >= 0.0:
        assert speed >= 0.0
        near = BRAKING * SETTLING_S
        stopping = speed**2 / (2.0 * BRAKING) + near * SETTLING_S / 2.0
        needed = stopping if speed > near else speed * SETTLING_S
        assert after == pytest.approx(needed, abs=1e-12)
    else:  # it cannot stop before the surface: at once, then
        assert speed == pytest.approx(0.0, abs=1e-12)


def test_the_safe_set_stays_safe_under_the_worst_allowed_commands() -> None:
    room, rate, before = 0.5, -0.1, -math.inf
    for _ in range(3000):
        least = Barrier("target", np.eye(3)[0], room, rate).least_acceleration(BRAKING, INTERVAL)
        assert least <= BRAKING + 1e-9  # the braking suffices at each step
        if before > 0.0:  # once it brakes, it never pushes forward again
            assert least >= -1e-12
        before = least
        room += rate * INTERVAL + 0.5 * least * INTERVAL**2
        rate += least * INTERVAL
        assert room >= -1e-12
    assert room < 1e-3  # and it comes as near as is allowed


def test_beyond_a_surface_a_chaser_returns_without_more_than_its_braking() -> None:
    inside = Barrier("target", np.eye(3)[0], -0.1, 0.0)
    assert inside.least_acceleration(BRAKING, INTERVAL) == BRAKING
    returning = Barrier("target", np.eye(3)[0], -0.1, RECOVERY_M_S)
    assert returning.least_acceleration(BRAKING, INTERVAL) == pytest.approx(0.0)
    assert stopping_speed(math.inf, -1.0, BRAKING, INTERVAL) == math.inf


def test_a_drift_is_taken_off_and_a_speed_limit_holds_alone() -> None:
    normal = np.eye(3)[1]
    free = Barrier("corridor", normal, 0.2, -0.03).least_acceleration(BRAKING, INTERVAL)
    drifting = Barrier("corridor", normal, 0.2, -0.03, drift_m_s2=0.004)
    assert drifting.least_acceleration(BRAKING, INTERVAL) == pytest.approx(free - 0.004)
    limited = Barrier("closing speed", normal, math.inf, -0.05, slowest_m_s=-0.04)
    assert limited.least_acceleration(BRAKING, INTERVAL) == pytest.approx(0.01 / INTERVAL)


def test_margins_are_those_along_the_normal_and_bounded() -> None:
    covariance = np.diag([4e-6, 1e-6, 9.0])
    offsets = OffsetEstimate(
        np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]),
        np.array([[0.3, -0.1, 0.2], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        covariance,
        np.array([covariance] * 3),
    )
    target, chaser, at_centre = distance_barriers(offsets, [0.5, 0.6, 0.6], NO_MARGIN)
    assert [b.hazard for b in (target, chaser, at_centre)] == ["target", "chaser", "chaser"]
    assert target.normal == pytest.approx([0.0, 1.0, 0.0])
    assert target.room_m == pytest.approx(1.5 - 0.003)
    assert target.rate_m_s == pytest.approx(-0.1 - 0.003)
    assert chaser.room_m == pytest.approx(1.4 - NO_MARGIN.most_m)
    assert chaser.rate_m_s == pytest.approx(-NO_MARGIN.most_m_s)
    assert at_centre.normal == pytest.approx([1.0, 0.0, 0.0])
    assert at_centre.room_m == pytest.approx(-0.606)


def test_in_the_corridor_a_uniform_motion_has_the_drift_that_it_is_seen_with(
    tmp_path: Path,
) -> None:
    scenario = assured(tmp_path, "docking-contact")
    docking, reach = scenario.docking, scenario.chaser.probe_reach_m
    port = docking.port_of(0)
    assert port is not None
    corridor = PortCorridor(port, reach, docking)
    rng = np.random.default_rng(4)
    q, omega = rotations.normalize(rng.normal(size=4)), np.array([0.03, -0.05, 0.04])
    velocity = np.array([0.01, -0.004, 0.006])
    start = rotations.rotate(q, centre_offset(port, reach, 0.2) + 0.001 * np.arange(3))

    def barriers(time_s: float) -> list[Barrier]:
        turned = rotations.integrate(q, omega, time_s)
        offset = OffsetEstimate(start + velocity * time_s, velocity, EXACT, EXACT)
        target = BodyState(np.zeros(3), np.zeros(3), turned, omega)
        assert corridor.holds(offset, target)
        attitude = rotations.multiply(turned, _looking_along(-np.asarray(port.axis)))
        return list(corridor.barriers(offset, target, attitude, BRAKING, INTERVAL, NO_MARGIN))

    step = 1e-4
    before, now, after = barriers(-step), barriers(0.0), barriers(step)
    assert [b.hazard for b in now] == ["corridor"] * 8 + ["closing speed"]
    for a, b, c in zip(before[:8], now[:8], after[:8], strict=True):
        assert b.rate_m_s == pytest.approx((c.room_m - a.room_m) / (2 * step), abs=1e-7)
        assert b.drift_m_s2 == pytest.approx((c.rate_m_s - a.rate_m_s) / (2 * step), abs=1e-7)


def test_a_wrong_attitude_closes_the_corridor(tmp_path: Path) -> None:
    scenario = assured(tmp_path, "docking-contact")
    docking, reach = scenario.docking, scenario.chaser.probe_reach_m
    port = docking.port_of(0)
    assert port is not None
    target = BodyState(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    offset = OffsetEstimate(centre_offset(port, reach, 0.2), np.zeros(3), EXACT, EXACT)
    right = _looking_along(-np.asarray(port.axis))
    wrong = rotations.multiply(right, rotations.exp(np.array([0.0, math.radians(6.0), 0.0])))
    corridor = PortCorridor(port, reach, docking)
    for q, closed in ((right, False), (wrong, True)):
        found = corridor.barriers(offset, target, q, BRAKING, INTERVAL, NO_MARGIN)
        assert ("alignment" in [b.hazard for b in found]) is closed


def _looking_along(ahead: Any) -> Any:
    side = np.cross(ahead, np.eye(3)[int(np.argmin(np.abs(ahead)))])
    side = side / np.linalg.norm(side)
    return rotations.from_matrix(np.column_stack([ahead, side, np.cross(ahead, side)]))


# -- nearest input ---------------------------------------------------------------------------------


def test_the_nearest_input_satisfies_the_conditions_and_no_other_is_nearer() -> None:
    rng = np.random.default_rng(1)
    limits = np.array([2.0, 1.0, 0.5])
    for _ in range(50):
        rows = rng.normal(size=(3, 3))
        inside = limits * rng.uniform(-0.9, 0.9, 3)
        conditions = Conditions(rows, rows @ inside - rng.uniform(0.0, 0.3, 3), limits)
        asked = limits * rng.uniform(-1.0, 1.0, 3)
        given, satisfied = nearest_input(asked, conditions)
        assert satisfied
        assert not len(conditions.missed(given + 1e-9 * (inside - given)))
        distance = np.linalg.norm((given - asked) / limits)
        others = limits * rng.uniform(-1.0, 1.0, (2000, 3))
        allowed = (others @ rows.T >= conditions.least).all(axis=1)
        nearest = np.linalg.norm((others[allowed] - asked) / limits, axis=1).min(initial=math.inf)
        assert distance <= nearest + 1e-9


def test_where_no_input_satisfies_all_the_least_margin_is_greatest() -> None:
    rows = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    conditions = Conditions(rows, np.array([0.5, 0.1]), np.array([1.0, 1.0, 0.0]))
    given, satisfied = nearest_input(np.array([0.9, 0.4, 0.3]), conditions)
    assert not satisfied
    assert given == pytest.approx([0.2, 0.4, 0.0], abs=2e-3)


# -- flights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("attack", ATTACKS)
def test_no_harmful_command_does_harm(tmp_path: Path, attack: Attack) -> None:
    scenario = assured(tmp_path, "four-chaser-capture")
    outcome = AssuredFlight(scenario, attack, seed=3).fly(20.0)
    assert outcome.target_room_m > 0.0
    assert outcome.chaser_room_m > 0.0
    assert outcome.corridor_room_m > 0.0
    docking = scenario.docking
    # A thrust 10 % stronger than known, over one tick, beyond the limit.
    assert outcome.closing_m_s < docking.corridor.closing_m_s + 0.01
    assert outcome.touch_m_s < docking.tolerances.closing_m_s + 0.002
    assert math.degrees(outcome.rate_rad_s) < 16.0
    assert outcome.states["changed"] > 100


@pytest.mark.parametrize(("attack", "room"), [("ram", "target_room_m"), ("chase", "chaser_room_m")])
def test_the_same_commands_do_harm_without_it(
    tmp_path: Path, attack: Attack, room: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class AsAsked(Assurance):
        def assure(self, command: Any, thrusts_N: Any, latched: bool) -> Any:
            return super().assure(command, thrusts_N, latched=True)

    monkeypatch.setattr("flights.assured.Assurance", AsAsked)
    scenario = assured(tmp_path, "four-chaser-capture")
    assert getattr(AssuredFlight(scenario, attack, seed=3).fly(20.0), room) < -0.1


def test_without_an_estimate_of_the_target_only_the_rate_is_bounded(tmp_path: Path) -> None:
    scenario = assured(tmp_path, "four-chaser-docking")
    flight = AssuredFlight(scenario, "spin", seed=1)
    assurance = Assurance(scenario, 0)
    odometry = flight._odometry(0, 0, 0)
    fast = msgspec.structs.replace(odometry, omega_rad_s=(0.1, 0.3, -0.2))
    assurance.add_odometry(fast)
    command = msgspec.structs.replace(
        flight._command(0, 0, 0), force_N=(1.0, -2.0, 0.5), torque_N_m=(0.02, 0.05, -0.05)
    )
    assured_command = assurance.assure(command, None, latched=False)
    assert assured_command.status.hazards == ("rate",)
    assert assured_command.command.force_N == (1.0, -2.0, 0.5)
    given = np.array(assured_command.command.torque_N_m)
    assert given @ np.array([0.1, 0.3, -0.2]) < 0.0


# -- in the chaser ---------------------------------------------------------------------------------


def test_a_chaser_without_the_section_publishes_no_status(tmp_path: Path) -> None:
    assert ChaserCore(assured(tmp_path, "four-chaser-docking"), 0).assurance is not None
    assert ChaserCore(load_scenario(find_scenario("four-chaser-docking")), 0).assurance is None


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("estimator.name=paper", "estimator.name"),
        ("limits.min_distance_target_m=0.0", "min_distance_target_m"),
        ("limits.min_distance_chasers_m=0.0", "min_distance_chasers_m"),
        ("assurance.braking_share=0.0", "braking_share"),
        ("assurance.max_rate_deg_s=-1.0", "max_rate_deg_s"),
    ],
)
def test_what_it_cannot_assure_is_refused(tmp_path: Path, override: str, text: str) -> None:
    with pytest.raises(ScenarioError, match=text):
        assured(tmp_path, "four-chaser-docking", override)


def test_events_name_begin_backup_and_end(tmp_path: Path) -> None:
    assurance = Assurance(assured(tmp_path, "four-chaser-docking"), 0)

    def said(time_s: float, state: Any) -> Any:
        status = AssuranceStatus(
            tick=round(10 * time_s),
            sim_time_ns=round(1e9 * time_s),
            chaser=0,
            state=state,
            hazards=("target",) if state in ("changed", "backup") else (),
            asked_force_N=(0.0, 0.0, 0.0),
            asked_torque_N_m=(0.0, 0.0, 0.0),
            room_m=0.0123,
        )
        return assurance._event(status)

    assert said(0.0, "unchanged") is None
    assert said(0.1, "changed") == (
        "warning",
        "assurance: command changed",
        "target; room 12 mm",
    )
    assert said(0.2, "changed") is None
    assert said(0.5, "unchanged") is None
    assert said(0.6, "backup")[1] == "assurance: backup command"
    assert said(0.7, "backup") is None
    assert said(1.8, "unchanged") == (
        "info",
        "assurance: commands unchanged again",
        "4 were changed",
    )
