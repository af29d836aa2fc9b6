# SPDX-License-Identifier: Apache-2.0
"""Docking by capture: phases, guards, time-outs, corridors and commands, without a world."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.guidance.activities.docking import pull_N
from chaserdock_controller.guidance.horizon import ReferenceBuilder
from chaserdock_controller.interfaces import RelativePose, TargetState
from docking_cases import DT_S, Pilot, senses
from flight_cases import at, drain, step


def test_all_phases_in_order_and_the_latch_armed_only_where_it_should_be() -> None:
    pilot = Pilot()
    seen = [(pilot.phase(), pilot.guidance.chasers[0].latch())]
    assert pilot.ask("approach") == (True, "phase align")
    for phase in ("align", "approach", "final", "contact"):
        pilot.fly_to(phase)
        seen.append((pilot.phase(), pilot.guidance.chasers[0].latch()))
    pilot.observed[0] = {"latched": True}
    for phase in ("latched", "verified"):
        pilot.fly_to(phase)
        seen.append((pilot.phase(), pilot.guidance.chasers[0].latch()))
    assert seen == [
        ("hold", "release"),
        ("align", "release"),
        ("approach", "release"),
        ("final", "arm"),
        ("contact", "arm"),
        ("latched", "arm"),
        ("verified", "arm"),
    ]
    observed = [what for _, what, _ in drain(pilot.guidance)]
    assert observed == ["hold", "align", "approach", "final", "contact", "latched", "verified"]


def test_the_approach_tapers_and_stays_on_the_axis() -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to("approach")
    docking, fastest = pilot.scenario.docking, 0.0
    while pilot.phase() in ("approach", "final"):
        position, velocity, _ = at(pilot.guidance.chasers[0].state.move, pilot.now_s)
        gap = -0.2 - 0.35 - position[0]
        speed = float(velocity[0])
        fastest = max(fastest, speed)
        assert abs(position[1]) < 1e-9
        assert abs(position[2] + 0.05) < 1e-9
        if -docking.overdrive_m / 3 < gap < docking.final_m - 0.001:
            assert speed == pytest.approx(docking.contact_speed_m_s, abs=1e-6)
        pilot.fly(DT_S)
        if gap < 0.0:
            break
    assert fastest == pytest.approx(docking.approach_speed_m_s, rel=1e-6)


def test_a_preset_states_what_its_source_does_and_leaves_the_rest() -> None:
    default = Pilot().scenario.docking
    soyuz = Pilot(
        docking={"final": {"preset": "soyuz"}, "tolerances": {"preset": "soyuz"}}
    ).scenario.docking
    assert soyuz.final == default.final.model_copy(update={"preset": "soyuz", "closing_m_s": 0.15})
    assert soyuz.tolerances == default.tolerances.model_copy(
        update={"preset": "soyuz", "closing_m_s": 0.15}
    )


def test_contact_conditions_of_a_preset_limit_the_final_approach() -> None:
    pilot = Pilot(docking={"final": {"preset": "idss", "lateral_m": 0.02}})
    final = pilot.scenario.docking.final
    assert (final.lateral_m, final.angle_deg, final.closing_m_s, final.rate_deg_s) == (
        0.02,
        4.0,
        0.10,
        0.20,
    )
    pilot.ask("approach")
    pilot.fly_to("final")
    pilot.observed[0] = {"angle_rad": np.radians(3.9), "rate_rad_s": np.radians(0.19)}
    pilot.fly(2 * DT_S)
    assert pilot.phase() == "final"
    drain(pilot.guidance)
    pilot.observed[0] = {"rate_rad_s": np.radians(0.21)}
    pilot.fly(2 * DT_S)
    assert pilot.phase() == "retreat"
    assert "left the corridor: rate 0.21 deg/s, at most 0.2" in drain(pilot.guidance)[0][2]


@pytest.mark.parametrize(
    ("phase", "observed", "why"),
    [
        ("approach", {"lateral_m": 0.04}, "left the corridor: lateral 40.00 mm"),
        ("approach", {"closing_m_s": 0.05}, "left the corridor: closing speed"),
        ("final", {"angle_rad": 0.05}, "left the corridor: angle"),
        ("final", {"lateral_speed_m_s": 0.01}, "left the corridor: lateral speed"),
        ("contact", {"lateral_m": 0.04, "contact": True}, "left the corridor"),
    ],
)
def test_a_broken_limit_leads_back_out_and_to_another_attempt(
    phase: str, observed: dict[str, float], why: str
) -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to(phase)
    drain(pilot.guidance)
    pilot.observed[0] = observed
    pilot.fly(2 * DT_S)
    assert pilot.phase() == "retreat"
    (event,) = drain(pilot.guidance)
    assert why in event[2]
    assert pilot.guidance.chasers[0].latch() == "release"
    pilot.observed[0] = {}
    pilot.fly_to("verified")
    assert pilot.guidance.chasers[0].state.attempt == 2


def test_after_the_last_attempt_it_holds_at_its_nominal_place() -> None:
    pilot = Pilot(docking={"attempts": 2})
    pilot.ask("approach")
    for _ in range(2):
        pilot.observed[0] = {}
        pilot.fly_to("final")
        pilot.observed[0] = {"lateral_m": 0.02}
        pilot.fly_to("retreat")
    pilot.fly_to("hold")
    np.testing.assert_allclose(
        at(pilot.guidance.chasers[0].state.move, pilot.now_s)[0], (-1.0, 0.0, -0.05), atol=1e-9
    )


@pytest.mark.parametrize(
    ("phase", "observed", "within_s"),
    [
        ("align", {"lateral_m": 0.2}, 61.0),
        ("final", {}, 31.0),
        ("contact", {"contact": True}, 6.0),
    ],
)
def test_nothing_lasts_for_ever(phase: str, observed: dict[str, Any], within_s: float) -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to(phase)
    pilot.observed[0] = observed
    pilot.fly_to("retreat", limit_s=within_s)


def test_a_latch_that_slips_under_the_pull_is_not_verified() -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to("latched")
    docking = pilot.scenario.docking
    pilot.fly(docking.settle_s + 2 * DT_S)
    assert pull_N(pilot.guidance.chasers[0], pilot.now_s) == docking.pull_N
    slipped = at(pilot.guidance.chasers[0].state.move, pilot.now_s)[0] - (0.006, 0.0, 0.0)
    step(pilot.guidance.chasers[0], pilot.now_s, port=senses(slipped, latched=True))
    assert pilot.phase() == "retreat"
    assert "moved 6.00 mm" in drain(pilot.guidance)[-1][2]


def test_a_chaser_whose_latch_does_not_open_waits_at_its_port() -> None:
    """For a second it takes the latch for slow; then it stays, and its way out begins when the
    latch opens.
    """
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to("verified")
    machine = pilot.guidance
    place = at(machine.chasers[0].state.move, pilot.now_s)[0]
    pilot.ask("retreat")
    drain(machine)

    def observe(seconds: float, latched: bool, sensed: bool = True) -> list[str]:
        for _ in range(round(seconds / DT_S)):
            pilot.now_s += DT_S
            port = replace(senses(place, latched=latched), sensed=sensed)
            step(machine.chasers[0], pilot.now_s, port=port)
        return [event[2] for event in drain(machine)]

    assert observe(0.8, latched=True) == []
    assert observe(2.0, latched=True, sensed=False) == []  # nothing is known of the latch
    assert not machine.chasers[0].state.stuck
    assert observe(20.0, latched=True) == ["the latch does not open"]
    assert pilot.phase() == "retreat"
    assert machine.chasers[0].state.stuck
    assert machine.chasers[0].latch() == "release"
    assert machine.chasers[0].min_distance_target_m() == 0.0
    np.testing.assert_allclose(at(machine.chasers[0].state.move, pilot.now_s)[0], place, atol=1e-9)
    assert observe(DT_S, latched=True, sensed=False) == []
    assert machine.chasers[0].state.stuck
    assert observe(DT_S, latched=False) == ["the latch opened"]
    assert not machine.chasers[0].state.stuck
    pilot.observed[0] = {}
    pilot.fly_to("hold")


def test_the_pull_gives_back_the_impulse_that_it_takes() -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to("latched")
    since_s, given = pilot.guidance.chasers[0].state.since_s, []
    while pilot.phase() == "latched":
        given.append(pull_N(pilot.guidance.chasers[0], pilot.now_s))
        pilot.fly(DT_S)
    assert max(given) == -min(given) == pilot.scenario.docking.pull_N
    assert abs(sum(given)) * DT_S <= pilot.scenario.docking.pull_N * DT_S
    assert pilot.now_s - since_s < 5.0


@pytest.mark.parametrize("phase", ["align", "approach", "final", "contact", "latched", "verified"])
@pytest.mark.parametrize("what", ["abort", "retreat"])
def test_from_every_phase_there_is_a_way_out_along_the_axis_and_in_again(
    phase: str, what: str
) -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to(phase)
    pilot.fly(0.0 if phase == "contact" else DT_S)
    assert pilot.ask(what) == (True, f"phase {what}")
    assert pilot.ask(what) == (True, f"already in phase {what}")
    pilot.observed[0] = {}
    assert pilot.guidance.chasers[0].latch() == "release"
    gap = -1.0
    while pilot.phase() == what:
        position = at(pilot.guidance.chasers[0].state.move, pilot.now_s)[0]
        assert abs(position[1]) < 1e-9
        assert -0.55 - position[0] >= gap - 1e-9 or phase == "align"
        gap = -0.55 - position[0]
        pilot.fly(DT_S)
    assert pilot.phase() == "hold"
    assert pilot.ask("approach")[0]
    pilot.fly_to("verified")


def test_commands_that_do_not_fit_are_refused_with_the_reason() -> None:
    pilot = Pilot()
    assert pilot.ask("approach", 5) == (False, "there is no chaser 5; this mission has 0 to 0")
    pilot.fly(5.0)
    accepted, reason = pilot.ask("approach", expires_ns=1_000_000_000)
    assert not accepted
    assert reason.startswith("stale: the command expired at 1.00 s")
    assert pilot.ask("approach", expires_ns=10_000_000_000)[0]
    assert pilot.ask("approach") == (True, "already in phase align")
    pilot.fly_to("latched")
    assert pilot.ask("hold") == (False, "in phase latched permitted: abort, retreat")
    assert not pilot.ask("goto", offset_m=(0.0, 2.0, 0.0))[0]


def test_of_two_operators_in_one_tick_the_first_counts_but_an_abort_always_does() -> None:
    pilot = Pilot()
    assert pilot.ask("approach", operator="ann")[0]
    assert pilot.ask("retreat", operator="bob") == (
        False,
        "approach by ann came first in this tick",
    )
    assert pilot.ask("approach", operator="bob")[0]
    assert pilot.ask("abort", operator="bob")[0]
    assert pilot.ask("approach", operator="ann") == (False, "abort by bob came first in this tick")
    pilot.fly(DT_S)
    assert pilot.ask("hold", operator="ann")[0]


def test_from_far_beside_the_axis_it_must_come_round_first() -> None:
    pilot = Pilot()
    assert pilot.ask("goto", offset_m=(0.0, 2.0, 0.0))[0]
    pilot.fly_to("hold", limit_s=200.0)
    accepted, reason = pilot.ask("approach")
    assert not accepted
    assert "beside the port's axis" in reason


def test_two_dock_at_once_and_a_chaser_in_the_way_waits() -> None:
    pilot = Pilot(chasers=4)
    pilot.ask("approach", 0)
    pilot.ask("approach", 1)
    assert pilot.ask("approach", 2) == (True, "phase wait")  # its port is on the face of chaser 0's
    assert pilot.ask("approach", 3) == (True, "phase wait")  # a third
    pilot.fly(1.0)
    assert [pilot.phase(i) for i in range(4)] == ["align", "align", "wait", "wait"]
    pilot.fly_to("verified", 0)
    pilot.fly(DT_S)
    assert pilot.phase(2) == "wait"
    assert pilot.phase(3) == "align"
    pilot.observed[0] = {}
    pilot.ask("retreat", 0)
    pilot.fly_to("align", 2, limit_s=120.0)


@pytest.mark.parametrize(("distance_m", "phase"), [(0.35, "wait"), (0.05, "align")])
def test_corridors_may_be_as_near_as_the_distance_between_chasers_allows(
    distance_m: float, phase: str
) -> None:
    pilot = Pilot(chasers=4, limits={"min_distance_chasers_m": distance_m})
    pilot.ask("approach", 0)
    assert pilot.ask("approach", 2) == (True, f"phase {phase}")  # on the same face


def test_corridor_replaces_the_keep_out_only_for_the_chaser_in_it() -> None:
    pilot = Pilot(chasers=2)
    limit = pilot.scenario.limits.min_distance_target_m
    assert pilot.guidance.chasers[0].min_distance_target_m() == limit
    pilot.ask("approach")
    pilot.fly_to("final")
    assert 0.4 < pilot.guidance.chasers[0].min_distance_target_m() < 0.53
    assert pilot.guidance.chasers[1].min_distance_target_m() == limit
    pilot.fly_to("verified")
    assert pilot.guidance.chasers[0].min_distance_target_m() == 0.0
    assert pilot.guidance.chasers[1].min_distance_target_m() == limit


@pytest.mark.parametrize(("phase", "pushed"), [("final", False), ("hold", True)])
def test_uncertainty_pushes_no_chaser_out_of_its_corridor(phase: str, pushed: bool) -> None:
    """Released from its port, with an uncertain pose, a chaser was planned around a larger
    keep-out, and left sideways.
    """
    pilot = Pilot()
    if phase != "hold":
        pilot.ask("approach")
    pilot.fly_to(phase)
    still, q = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    target = TargetState(0, still, still, q, still, np.eye(12) * 1e-8, "predicting", 0, ())
    builder, planned = ReferenceBuilder(pilot.scenario), pilot.guidance.chasers
    limit_m = pilot.guidance.chasers[0].min_distance_target_m()
    for sigma_m, margin_m in ((0.001, 0.003), (0.03, 0.09)):
        place = RelativePose(np.array([-limit_m - 0.02, 0.0, 0.0]), q, np.eye(6) * sigma_m**2)
        body = TargetBody(40.0, np.eye(3), still)
        kept_m = builder.horizon(planned, target, body, frozenset(), [place]).min_distance_target_m[
            0
        ]
        assert kept_m == pytest.approx(limit_m + (margin_m if pushed else min(margin_m, 0.02)))


def test_when_the_target_is_lost_an_approach_is_broken_off_and_a_latch_is_not() -> None:
    pilot = Pilot()
    pilot.ask("approach")
    pilot.fly_to("final")
    pilot.guidance.chasers[0].lose_target(pilot.now_s)
    assert pilot.phase() == "retreat"
    other = Pilot()
    other.ask("approach")
    other.fly_to("verified")
    other.guidance.chasers[0].lose_target(other.now_s)
    assert other.phase() == "verified"
