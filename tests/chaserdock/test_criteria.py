# SPDX-License-Identifier: Apache-2.0
"""The criteria ``success.reached``, ``success.detumbled`` and those of published rendezvous tasks:
evaluation and validation.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from motion_cases import track, true_motion

from chaserdock.analysis.criteria import (
    _captures,
    _poses,
    _rest,
    judge,
    judged_criteria,
    reached_time,
    stack_rest,
)
from chaserdock.analysis.rendezvous import rendezvous_criteria, rendezvous_of
from chaserdock.analysis.stack import stack_motion
from chaserdock.criterion import (
    COLUMNS,
    Criterion,
    criterion,
    html_table,
    markdown_table,
    table_rows,
    text_table,
)

PATH = Path(__file__).resolve().parents[2] / "scenarios" / "collision-avoidance.toml"


def scenario(*overrides: str) -> Scenario:
    return load_scenario(PATH, overrides)


def failures(rows: Iterable[Criterion]) -> list[str]:
    return [row.failure for row in rows if row.outcome == "not met"]


def flight(s: Scenario, chaser_m: np.ndarray, target_q: np.ndarray) -> Any:
    """Return a stub of a recorded flight with one row per second."""
    time_s = np.arange(len(chaser_m), dtype=float)
    tracks = {
        "target": track(time_s, q_wxyz=target_q),
        "chaser/0": track(time_s, position_m=chaser_m),
    }
    return SimpleNamespace(
        scenario=s, motion=true_motion(tracks), estimated_frame=lambda target: target
    )


def test_goal_counts_as_reached_from_when_the_chaser_stays() -> None:
    """The goal rotates with the target. Passing through it and being there before the command do
    not count.
    """
    s, n = scenario(), 80
    turning = np.array([rotations.exp([0.0, 0.0, 0.01 * k]) for k in range(n)])
    goal = rotations.rotate(turning, np.tile([1.0, 0.0, 0.0], (n, 1)))
    away = np.zeros((n, 3))
    away[:40] = [0.0, 0.0, 0.021]
    away[30] = 0.0
    assert reached_time(flight(s, goal + away, turning), 0) == 40.0
    assert reached_time(flight(s, goal, turning), 0) == 10.0
    away[-1] = [0.021, 0.0, 0.0]
    assert reached_time(flight(s, goal + away, turning), 0) is None
    assert reached_time(flight(s, goal, turning), 1) is None  # has no goto


@pytest.mark.parametrize(
    ("time_s", "violations"),
    [
        (69.9, []),
        (70.1, ["at its goal since, chaser 0: 70.10 s, at most 70 s; to the end, within 20 mm"]),
        (None, ["at its goal since, chaser 0: never, at most 70 s; to the end, within 20 mm"]),
    ],
)
def test_violations_name_chaser_and_limit(time_s: float | None, violations: list[str]) -> None:
    steady = {"position_mse_m2": 1e-6, "orientation_mse_rad2": 1e-6}
    own = {"min_distance_target_m": 1.0, "reached_time_s": time_s, "steady": steady}
    other = own | {"reached_time_s": None}  # has no goto
    result = {"sim_time_s": 120.0, "chasers": {"0": own, "1": other}}
    assert failures(_poses(result, scenario())) == violations


def test_last_goto_defines_the_goal() -> None:
    s = scenario()
    first = s.timeline[0]
    later = first.model_copy(update={"at_s": 30.0, "offset_m": (0.0, 0.0, 1.0)})
    both = s.model_copy(update={"timeline": (later, first)})
    assert both.goal_of(0) == (30.0, (0.0, 0.0, 1.0))
    assert both.goal_of(1) is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("success.reached=[1]", "success.reached: no goto of the timeline names chaser 1"),
        ("success.reached=[5]", "success.reached: there is no chaser 5; this mission has 0 to 1"),
        ("success.reached_position_m=0", "success.reached_position_m"),
    ],
)
def test_invalid_criteria_are_named(override: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message.replace(".", r"\.")):
        scenario(override)


DETUMBLE = PATH.parent / "detumble-pair.toml"
STEP_S = 0.1


def stack_flight(
    speed_m_s: np.ndarray, omega_rad_s: np.ndarray, latched: tuple[int, ...] = (0,)
) -> Any:
    """Return a stub of a recorded flight of ``detumble-pair``: the stack of target and chaser 0
    moves along +x with the speeds of its centre (K,), and turns about +z with the rates (K,).
    Chaser 1 flies elsewhere, fast."""
    n = len(speed_m_s)
    times = np.arange(n) * STEP_S
    target_kg, chaser_kg, apart_m = 150.0, 50.0, np.array([-1.0, 0.0, 0.0])
    turning = np.outer(omega_rad_s, [0.0, 0.0, 1.0])
    # The common centre is a quarter of the way to the chaser.
    origin = np.outer(speed_m_s, [1.0, 0.0, 0.0]) - np.cross(turning, apart_m / 4.0)

    def moving(velocity: np.ndarray, place_m: np.ndarray | None = None) -> Any:
        place_m = np.tile(np.zeros(3) if place_m is None else place_m, (n, 1))
        return track(times, position_m=place_m, velocity_m_s=velocity, omega_rad_s=turning)

    def drawn(name: str, mass_kg: float) -> Any:
        return SimpleNamespace(
            body=name,
            mass_kg=mass_kg,
            centre_of_mass_m=(0.0, 0.0, 0.0),
            inertia_kg_m2=(20.0, 0.0, 0.0, 0.0, 20.0, 0.0, 0.0, 0.0, 20.0),
        )

    return SimpleNamespace(
        scenario=load_scenario(DETUMBLE),
        motion=true_motion(
            {
                "target": moving(origin),
                "chaser/0": moving(origin + np.cross(turning, apart_m), apart_m),
                "chaser/1": moving(np.ones((n, 3))),
            }
        ),
        drawn=(
            drawn("target", target_kg),
            drawn("chaser/0", chaser_kg),
            drawn("chaser/1", chaser_kg),
        ),
        latched=latched,
    )


def test_the_stack_is_at_rest_from_when_speed_and_rate_stay_below_the_limits() -> None:
    """Limits of 1 mm/s and 0.05 degrees/s; the speed is that of the common centre, which does not
    move when the stack turns.
    """
    speed, rate = np.full(100, 0.0009), np.full(100, np.radians(0.049))
    speed[:30], rate[:40] = 0.01, 0.1
    rate[60] = np.radians(0.051)
    rest = stack_rest(stack_flight(speed, rate))
    assert rest is not None
    assert rest["since_s"] == pytest.approx(6.1)
    assert rest["speed_m_s"] == pytest.approx(0.0009)
    assert rest["rate_rad_s"] == pytest.approx(np.radians(0.049))
    assert failures(_rest({"stack": rest}, load_scenario(DETUMBLE))) == []


@pytest.mark.parametrize(
    ("speed_m_s", "rate_deg_s", "text"),
    [
        (
            0.0011,
            0.01,
            "speed of the stack: 1.10 mm/s, at most 1 mm/s",
        ),
        (
            0.0002,
            0.06,
            "rate of the stack: 0.0600 °/s, at most 0.05 °/s",
        ),
    ],
)
def test_a_stack_that_moves_at_the_end_violates_the_criterion(
    speed_m_s: float, rate_deg_s: float, text: str
) -> None:
    speed, rate = np.zeros(50), np.zeros(50)
    speed[-1], rate[-1] = speed_m_s, np.radians(rate_deg_s)
    rest = stack_rest(stack_flight(speed, rate))
    assert rest is not None
    assert rest["since_s"] is None
    assert failures(_rest({"stack": rest}, load_scenario(DETUMBLE))) == [text]


def test_a_released_chaser_is_no_part_of_the_stack() -> None:
    """Without chaser 0 the speed is that of the target, whose centre circles the former common
    centre.
    """
    turning = np.full(20, np.radians(0.04))
    rest = stack_rest(stack_flight(np.zeros(20), turning, latched=()))
    assert rest is not None
    assert rest["speed_m_s"] == pytest.approx(0.25 * np.radians(0.04))
    both = stack_rest(stack_flight(np.zeros(20), turning))
    assert both is not None
    assert both["speed_m_s"] == pytest.approx(0.0, abs=1e-12)


def test_momentum_of_a_stack_contains_spin_and_orbit_of_its_bodies_while_they_belong_to_it() -> (
    None
):
    """Target and chaser of 20 kg m^2 each, 150 kg and 50 kg 1 m apart: 77.5 kg m^2 in all."""
    flight = stack_flight(np.full(10, 0.3), np.full(10, 0.02))
    both = stack_motion(flight, {0: None})
    assert both is not None
    np.testing.assert_allclose(both.angular_momentum_N_m_s, 77.5 * 0.02)
    np.testing.assert_allclose(both.speed_m_s, 0.3)
    late = stack_motion(flight, {0: np.arange(10) >= 5})
    assert late is not None
    np.testing.assert_allclose(late.angular_momentum_N_m_s[[4, 5]], [20.0 * 0.02, 77.5 * 0.02])
    assert stack_motion(flight, {7: None}) is None


def test_rest_without_truth_or_criterion_is_not_judged() -> None:
    stub = stack_flight(np.zeros(5), np.zeros(5))
    s = stub.scenario
    stub.motion = true_motion({})
    assert stack_rest(stub) is None
    assert "the motion of the stack is not in the log" in failures(_rest({}, s))[0]
    none = s.model_copy(update={"success": s.success.model_copy(update={"detumbled": None})})
    assert failures(_rest({}, none)) == []
    judged, skipped = judged_criteria(load_scenario(DETUMBLE, ("duration_s=40.0",)))
    assert judged.success.detumbled is None
    assert "success.detumbled: the flight ends at 40 s, detumble is at 50 s" in skipped
    assert judged_criteria(s)[0].success.detumbled is not None


AFRL, ARCH = (PATH.parent / f"{name}.toml" for name in ("afrl-docking", "arch-comp-rendezvous"))


def approach_flight(
    s: Scenario, offsets_m: np.ndarray, speeds_m_s: np.ndarray, abort_s: float | None = None
) -> Any:
    """Return a stub of a recorded flight with one row per second: chaser 0 at offsets (K, 3), TRF
    of a target that is turned by 90 degrees about +z, at speeds (K,) relative to it."""
    n = len(offsets_m)
    turned = np.tile(rotations.exp([0.0, 0.0, np.pi / 2.0]), (n, 1))
    drift = np.tile([0.0, 0.0, 0.3], (n, 1))
    time_s = np.arange(n, dtype=float)
    target = track(time_s, position_m=np.ones((n, 3)), q_wxyz=turned, velocity_m_s=drift)
    own = track(
        time_s,
        position_m=target.position_m + rotations.rotate(turned, offsets_m),
        velocity_m_s=drift + np.outer(speeds_m_s, [1.0, 0.0, 0.0]),
    )
    phases = [(0.0, "hold")] + ([] if abort_s is None else [(abort_s, "abort")])
    return SimpleNamespace(
        scenario=s,
        motion=true_motion({"target": target, "chaser/0": own}),
        references={0: SimpleNamespace(phases=phases)},
    )


def with_arrival(s: Scenario, **changes: float) -> Scenario:
    assert s.success.arrival is not None
    arrival = s.success.arrival.model_copy(update=changes)
    return s.model_copy(update={"success": s.success.model_copy(update={"arrival": arrival})})


def judged(stub: Any) -> list[str]:
    found = rendezvous_of(stub, 0)
    assert found is not None
    result = {"sim_time_s": 9999.0, "chasers": {"0": {"rendezvous": found}}}
    return failures(rendezvous_criteria(result, stub.scenario))


def inwards(distances_m: np.ndarray, away_deg: float = 0.0) -> np.ndarray:
    angle = np.radians(away_deg)
    return np.outer(distances_m, [-np.cos(angle), np.sin(angle), 0.0])


def test_speed_limit_of_afrl_holds_at_every_distance() -> None:
    """v <= 0.2 + 2 n (d - 0.5), n = 0.001027 rad/s."""
    s, distance = load_scenario(AFRL), np.linspace(150.0, 0.48, 60)
    limit = 0.2 + 2.0 * 0.001027 * (distance - 0.5)
    # On arrival the limit is that of the arrival, too, which is as large.
    assert (
        judged(
            approach_flight(s, inwards(distance), np.minimum(limit - 1e-6, 0.1999 + limit - 0.2))
        )
        == []
    )
    for row in (0, 30, 58):
        fast = limit - 1e-3
        fast[row] += 0.011
        (failure,) = judged(approach_flight(s, inwards(distance), fast))
        assert failure == "below the speed limit, chaser 0: -10.0 mm/s, at least 0 mm/s"


def test_a_deputy_of_afrl_must_come_within_half_a_metre_slowly() -> None:
    s, text = (
        load_scenario(AFRL),
        "arrived at, chaser 0: never, at most 9999 s; "
        "within 0.5 m of the target, at 0.2 m/s or less",
    )
    assert judged(approach_flight(s, inwards(np.linspace(100.0, 0.51, 50)), np.full(50, 0.1))) == [
        text
    ]
    slow = with_arrival(s, speed_m_s=0.05)
    assert judged(
        approach_flight(slow, inwards(np.linspace(100.0, 0.49, 50)), np.full(50, 0.1))
    ) == [text.replace("0.2 m/s", "0.05 m/s")]
    found = rendezvous_of(
        approach_flight(s, inwards(np.linspace(99.0, 0.0, 100)), np.full(100, 0.1)), 0
    )
    assert found is not None
    assert (found["arrived_s"], found["arrived_speed_m_s"]) == (99.0, pytest.approx(0.1))
    early = with_arrival(s, within_s=98.0)
    assert judged(
        approach_flight(early, inwards(np.linspace(99.0, 0.0, 100)), np.full(100, 0.1))
    ) == [text.replace("never, at most 9999", "99.00 s, at most 98")]


def test_cone_and_speed_of_arch_comp_hold_nearby_and_until_the_abort() -> None:
    s, distance = load_scenario(ARCH), np.linspace(900.0, 4.0, 400)
    speed = np.where(distance <= 108.3, 0.054, 0.5)
    assert judged(approach_flight(s, inwards(distance, 29.0), speed)) == []
    (outside,) = judged(approach_flight(s, inwards(distance, 31.0), speed))
    assert outside.startswith(
        "off the approach cone, chaser 0: 31.0 °, at most 30 °; within 108.3 m"
    )
    offsets = inwards(distance, 29.0)
    offsets[distance > 109.0] = [900.0, 0.0, 0.0]
    assert judged(approach_flight(s, offsets, speed)) == []
    (fast,) = judged(approach_flight(s, inwards(distance), np.where(distance <= 108.3, 0.056, 0.5)))
    assert fast == "below the speed limit, chaser 0: -1.00 mm/s, at least 0 mm/s"
    # Both end with the abort.
    after = np.vstack([inwards(distance), np.tile([0.0, 50.0, 0.0], (10, 1))])
    speeds = np.concatenate([speed, np.full(10, 0.2)])
    assert judged(approach_flight(s, after, speeds, abort_s=400.0)) == []
    assert len(judged(approach_flight(s, after, speeds, abort_s=402.0))) == 2


def test_an_abort_must_stay_clear_of_the_box() -> None:
    """The box has a half edge of 0.2 m along the axes of TRF; before the abort it may be
    entered.
    """
    s, distance = load_scenario(ARCH), np.linspace(900.0, 4.0, 400)
    inside, passing = np.array([[0.1, -0.19, 0.0]]), np.array([[0.1, -0.21, 0.0]])
    flown = np.zeros(401)
    near = np.vstack([inwards(distance), inside])
    (failure,) = judged(approach_flight(s, near, flown, abort_s=400.0))
    assert failure.startswith(
        "clear after abort, chaser 0: 0.190 m, at least 0.2 m; half edge of a cube"
    )
    assert (
        judged(approach_flight(s, np.vstack([inwards(distance), passing]), flown, abort_s=400.0))
        == []
    )
    early = np.vstack([inwards(distance), [[-0.1, 0.0, 0.0]], [[-3.0, 0.0, 0.0]]])
    assert judged(approach_flight(s, early, np.zeros(402), abort_s=401.0)) == []


def test_flights_without_criteria_of_a_rendezvous_have_no_such_figures() -> None:
    assert rendezvous_of(approach_flight(scenario(), inwards(np.ones(3)), np.zeros(3)), 0) is None


def test_arrival_is_not_judged_before_its_goto() -> None:
    shortened, skipped = judged_criteria(load_scenario(AFRL, ("duration_s=30.0",)))
    assert shortened.success.arrival is None
    assert "success.arrival, chaser 2: the flight ends at 30 s, its goto is at 40 s" in skipped
    assert judged_criteria(load_scenario(AFRL))[0].success.arrival is not None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "success.arrival.chasers=[0, 3]",
            "success.arrival.chasers: there is no chaser 3; this mission has 0 to 2",
        ),
        ("success.speed_limit.speed_m_s=0", "success.speed_limit.speed_m_s"),
        (
            "success.approach_cone={half_angle_deg=30, axis=[0, 0, 0], within_m=10}",
            "axis: must not be 0",
        ),
        (
            "success.approach_cone={half_angle_deg=95, axis=[1, 0, 0], within_m=10}",
            "success.approach_cone.half_angle_deg",
        ),
        ("success.abort_clear_m=-1", "success.abort_clear_m"),
    ],
)
def test_invalid_criteria_of_a_rendezvous_are_named(override: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message.replace(".", r"\.")) as caught:
        load_scenario(AFRL, (override,))
    assert str(caught.value).count("\n") <= 1


def pose_errors(*position_mm: float) -> list[Criterion]:
    return [
        criterion("steady_position_rms_m", "steady position RMS", value, 8.0, "mm", i)
        for i, value in enumerate(position_mm)
    ]


def test_table_shows_the_chaser_with_the_least_margin_and_each_violation() -> None:
    rows = table_rows(pose_errors(1.0, 7.0, 8.5, 9.0))
    assert [(r.criterion.outcome, r.who, r.criterion.cells) for r in rows] == [
        ("met", "1, worst of 2", ("7.00 mm", "≤ 8 mm", "1.00 mm")),
        ("not met", "2", ("8.50 mm", "≤ 8 mm", "-0.500 mm")),
        ("not met", "3", ("9.00 mm", "≤ 8 mm", "-1.00 mm")),
    ]


def test_margin_is_positive_on_the_side_that_is_allowed() -> None:
    """Of a smallest allowed value it lies above."""
    far = criterion("keep_distances", "between chasers", 0.5, 0.35, "m", side="at least")
    near = criterion("keep_distances", "between chasers", 0.3, 0.35, "m", side="at least")
    assert (far.outcome, far.margin) == ("met", pytest.approx(0.15))
    assert (near.outcome, near.margin) == ("not met", pytest.approx(-0.05))


def test_criterion_that_is_not_judged_states_its_limit_and_why() -> None:
    s = load_scenario(DETUMBLE, ("duration_s=40.0",))
    capture = {"latch_time_s": 30.0, "latched": True, "verified": False, "refused": []}
    result = {
        "sim_time_s": 40.0,
        "ended": "",
        "collisions": None,
        "min_distance_chasers_m": None,
        "stack": {"speed_m_s": 0.1, "rate_rad_s": 0.1, "since_s": None},
        "target_estimate": {},
        "chasers": {
            i: {
                "min_distance_target_m": None,
                "capture": capture,
                "relative_estimate": {
                    "max_position_error_m": None,
                    "max_orientation_error_rad": None,
                },
            }
            for i in "01"
        },
    }
    skipped = [*judged_criteria(s)[1], "collisions: the log has no ground truth of contacts"]
    rows = {row.name: row for row in judge(result, s, skipped)}
    rate = rows["rate of the stack"]
    assert (rate.outcome, rate.measured, rate.limit) == ("not judged", None, 0.05)
    assert rate.note == "the flight ends at 40 s, detumble is at 50 s"
    assert rows["collisions"].outcome == "not judged"
    reason = "success.latched: the flight ends at 40 s, its approach is at 50 s"
    late = {row.name: row for row in judge(result, s, [reason])}["latched and verified"]
    assert (late.outcome, late.limit) == ("not judged", None)
    assert rows["latched and verified"].outcome == "not met"
    assert "not verified by a pull test" in rows["latched and verified"].failure


def test_table_fits_the_terminal_and_says_the_same_everywhere() -> None:
    note = "a reason that is long: " + "word " * 30
    rows = [
        *pose_errors(123.4, 1.0),
        criterion("steady_orientation_rms_deg", "steady orientation RMS", 0.01, 0.3, "°", 15),
        criterion("docked", "docking pose since", 97.333, 115.0, "s", 10, note="to the end"),
        Criterion(key="a", name="orientation estimate", outcome="not judged", note=note),
    ]
    lines = text_table(rows)
    assert max(map(len, lines)) <= COLUMNS
    shown = ("\n".join(lines), html_table(rows), markdown_table(rows).replace("\xa0", " "))
    for part in ("steady position RMS", "123 mm", "≤ 8 mm", "-115 mm", "97.33 s", "a reason that"):
        assert all(part in text for text in shown), part
    assert '<td class="partial">not judged</td>' in shown[1]


def test_table_of_many_chasers_and_long_values_fits_the_terminal() -> None:
    rows = [
        criterion("a", "steady orientation RMS", -0.012345, 0.5323, "mm/s", i, "at least", met=True)
        for i in range(16)
    ]
    rows.append(Criterion(key="b", name="orientation estimate", outcome="not judged"))
    lines = text_table(rows)
    assert max(map(len, lines)) <= COLUMNS
    assert "worst of 16" in lines[1]
    assert lines[1].endswith("≥ 0.5323 mm/s")


def test_a_latch_that_let_go_is_no_capture() -> None:
    """The last rejected touch says why no other closed it."""
    s = load_scenario(DETUMBLE)
    gone = {"latch_time_s": 30.0, "latched": False, "verified": True, "refused": ["too fast"]}
    result = {"sim_time_s": 75.0, "chasers": {"0": {"capture": gone}}}
    first, second = _captures(result, s)
    assert first.failure.endswith("chaser 0: never, at most 75 s; last rejected touch: too fast")
    assert second.outcome == "not met"
