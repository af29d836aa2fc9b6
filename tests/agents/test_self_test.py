# SPDX-License-Identifier: Apache-2.0
"""Test burns: they leave the motion of a healthy chaser as it is, reach every thruster in turn, and
find the idle one that has failed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.thrusters.allocation import allocator_of
from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_agents.chaser.thrusters.self_test import MAX_TEST_PULSES, ThrusterSelfTest
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.thrusters import thrusts_max
from flights.measured_poses import measurement_model
from thruster_cases import at_rest, mission, wrench

from chaserdock.experiments.flight_record import record_flight

PERIOD_S, S = 0.1, 1_000_000_000


class Bench:
    """The self-test of a body's thrusters without a chaser. The caller adds the pulses of each burn
    and may state in ``needed`` of how many ticks the motion tells whether a thruster works.
    """

    def __init__(self, body: str = "tetra12", every_s: float = 10.0) -> None:
        chaser = mission(body).chaser
        self.full = thrusts_max(chaser.thrusters)
        self.allocator = allocator_of(chaser)
        self.least = self.full * [t.min_on_s for t in chaser.thrusters]
        self.needed: int | None = 2
        self.self_test = ThrusterSelfTest(
            self.allocator, self.least, every_s, lambda thruster: self.needed
        )
        self.able = np.ones(len(self.full), dtype=np.bool_)

    def burn(
        self, now_ns: int, can: Array | None = None, asked: Array | None = None
    ) -> Array | None:
        can, asked = self.full if can is None else can, 0.0 * self.full if asked is None else asked
        return self.self_test.schedule(now_ns, self.able & (can > 0.0), can, asked, PERIOD_S)


@pytest.mark.parametrize("body", ["tetra12", "slider"])
@pytest.mark.parametrize("lost", [None, 3])
def test_burns_cancel_reach_every_thruster_and_then_stop(body: str, lost: int | None) -> None:
    bench, tested = Bench(body), np.zeros(0)
    can = bench.full.copy()
    if lost is not None:
        can[lost] = 0.0
    now_ns, burns = 0, 0
    while (impulses := bench.burn(now_ns, can)) is not None:
        np.testing.assert_allclose(bench.allocator.matrix @ impulses, 0.0, atol=1e-9)
        assert np.all(impulses >= -1e-12)
        assert lost is None or impulses[lost] == 0.0
        fired = impulses >= 0.5 * bench.least
        assert fired.sum() >= 2  # what cancels it is not too little to fire
        bench.self_test.add_pulses(fired, now_ns)
        tested = np.union1d(tested, np.flatnonzero(fired))
        now_ns, burns = now_ns + S // 2, burns + 1
        assert burns <= 2 * len(can)
    assert len(tested) == len(can) - (lost is not None)
    # They are repeated when the results have become too old, and not before.
    assert bench.burn(9 * S, can) is None
    assert bench.burn(now_ns + 11 * S, can) is not None


def test_a_thruster_is_tested_until_the_motion_tells_and_again_after_a_while() -> None:
    bench = Bench()
    bench.needed = None
    fires = np.arange(12) == 4
    bench.self_test.add_pulses(fires, S)
    assert bench.self_test.untested(S).all()
    bench.needed = 3
    bench.self_test.add_pulses(fires, 2 * S)
    assert bench.self_test.untested(2 * S).all()
    bench.self_test.add_pulses(fires, 4 * S)
    assert (bench.self_test.untested(4 * S) == ~fires).all()
    # Known for ten seconds from the first of the three ticks; a reset does not change that.
    bench.self_test.reset()
    assert (bench.self_test.untested(11 * S) == ~fires).all()
    assert bench.self_test.untested(11 * S + 1).all()


@pytest.mark.parametrize(("apart_s", "tested"), [(1, True), (2, False)])
def test_pulses_that_never_tell_are_not_repeated_for_ever(apart_s: int, tested: bool) -> None:
    bench = Bench()
    bench.needed = None
    for k in range(MAX_TEST_PULSES):
        assert bench.self_test.untested(k * apart_s * S).all()
        bench.self_test.add_pulses(bench.able, k * apart_s * S)
    untested = bench.self_test.untested((MAX_TEST_PULSES - 1) * apart_s * S)
    assert (untested == (not tested)).all()


def test_burns_are_apart_and_only_where_there_is_room() -> None:
    bench = Bench()
    assert bench.burn(0, asked=bench.full * 0.85) is None
    assert bench.burn(0) is not None
    assert bench.burn(S // 4) is None
    assert bench.burn(S // 2) is not None
    assert Bench(every_s=0.0).burn(0) is None


def fired(
    navigation: dict[str, float] | None = None, chaser: Any = None, **command_as: Any
) -> set[int]:
    """Return the thrusters that open within three seconds of zero commands."""
    s = mission(chaser=chaser or {}, navigation={"grade": "exact", **(navigation or {})})
    pilot, out = ThrusterController(s, 0), set()
    for tick in range(45):
        pilot.observe(at_rest(s, tick))
        command = wrench(s, tick, **command_as)
        pilot.apply_command(command)
        out |= {p.thruster for p in pilot.add_pulses(passed_on(command)).pulses}
    return out


def test_thrusters_are_tested_when_enabled_and_observable() -> None:
    assert len(fired()) >= 3
    assert fired(chaser={"thruster_test_s": 0}) == set()
    assert len(fired({"velocity_noise_m_s": 0.001, "omega_noise_deg_s": 0.05})) >= 3
    # Where odometry noise hides a minimum pulse, tests would never end.
    assert fired({"velocity_noise_m_s": 0.01, "omega_noise_deg_s": 1.0}) == set()


def test_no_tests_near_contact_or_while_held() -> None:
    """The latch is armed from the final approach on (test_capture_guidance)."""
    assert len(fired(latch="release")) >= 3
    assert fired(latch="arm") == set()
    assert fired(free=False) == set()


@pytest.mark.slow
@pytest.mark.parametrize(("test_s", "finds"), [(10.0, True), (0.0, False)])
def test_an_idle_thruster_that_sticks_off_is_found(test_s: float, finds: bool) -> None:
    """Thruster 11 of tetra12 is not used at the paper's rates: without tests its failure stays
    undetected.
    """
    failure = {"chaser": 0, "thruster": 11, "at_s": 8.0, "kind": "stuck_off"}
    scenario = mission(
        duration_s=26.0, chaser={"thruster_test_s": test_s}, thruster_failure=[failure]
    )
    record = record_flight(scenario, measurement_model(scenario, 0))
    reports = [what for _, _, what in record.thruster_events if "limits" not in what]
    assert reports == (["thruster 11 stuck off: detected, isolated"] if finds else [])
    assert record.position_error_m[record.time_s > 8.0].max() < 0.05
