# SPDX-License-Identifier: Apache-2.0
"""Which thruster has failed: found from residuals alone, and never where nothing has."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_agents.chaser.thrusters.allocation import allocator_of
from chaserdock_agents.chaser.thrusters.fault_detection import (
    Flags,
    ThrusterFault,
    ThrusterFaultDetector,
    is_consistent,
)
from chaserdock_agents.chaser.thrusters.impulse_residual import (
    ImpulseNoise,
    PlantMismatch,
    covariance,
    mismatch_signatures,
    noise_of,
    observed_impulse,
)
from chaserdock_agents.chaser.thrusters.self_test import ThrusterSelfTest
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import propagate
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.thrusters import thrusts_max
from flight_cases import start
from thruster_cases import mission

TICK_S = 1.0 / 15


class Case:
    """A body whose odometry comes from integrating what its thrusters really give.

    With ``mismatched`` the true mass, inertia, centre of mass and thrusts are drawn with the
    assumed sigmas.
    """

    def __init__(
        self,
        body: str,
        seed: int,
        noise: ImpulseNoise | None = None,
        odometry_noise: bool = False,
        mismatched: bool = False,
    ) -> None:
        self.body: Body = mission(body).chaser
        draw, sigma = np.random.default_rng((seed, 1)), PlantMismatch()
        shares = draw.normal(size=4 + len(self.body.thrusters)) * mismatched
        self.true_body = self.body.model_copy(
            update={
                "mass_kg": self.body.mass_kg * (1 + sigma.mass * shares[0]),
                "inertia_kg_m2": tuple(
                    (np.array(self.body.inertia) * (1 + sigma.inertia * shares[1:4])).tolist()
                ),
            }
        )
        self.thrust = 1 + sigma.thrust * shares[4:]
        self.centre_m = sigma.centre_of_mass_m * draw.normal(size=3) * mismatched
        self.force_N = sigma.force_N * draw.normal(size=3) * mismatched
        self.noise = noise or ImpulseNoise()
        self.matrix, self.full = (
            wrench_matrix(self.body.thrusters),
            thrusts_max(self.body.thrusters),
        )
        self.least = self.full * [t.min_on_s for t in self.body.thrusters]
        min_on_s = np.array([t.min_on_s for t in self.body.thrusters])
        self.watch = ThrusterFaultDetector(self.matrix, min_on_s, 13 + len(self.full))
        self.rng = np.random.default_rng(seed)
        self.state = start(seed)
        self.state[3:6] *= 0.05
        self.state[10:13] *= 0.05
        self.jitter = odometry_noise
        self.tick = 0
        self.last = self._odometry()

    def _odometry(self) -> Odometry:
        x = self.state.copy()
        if self.jitter:
            x[3:6] += self.rng.normal(size=3) * self.noise.velocity_m_s
            x[10:13] += self.rng.normal(size=3) * self.noise.omega_rad_s
        v = [tuple(part.tolist()) for part in (x[:3], x[3:6], x[6:10], x[10:13])]
        return Odometry(
            chaser=0,
            tick=self.tick,
            sim_time_ns=round(self.tick * TICK_S * 1e9),
            position_m=v[0],
            velocity_m_s=v[1],
            q_wxyz=v[2],
            omega_rad_s=v[3],
        )

    def step(
        self,
        asked_N_s: Array,
        given_N_s: Array,
        suspects: Flags | None = None,
        known_N: Array | None = None,
    ) -> ThrusterFault | None:
        wrench = self.matrix @ (given_N_s * self.thrust) / TICK_S
        wrench[:3] += self.force_N
        wrench[3:] -= np.cross(self.centre_m, wrench[:3])
        self.state = propagate(self.state, wrench, self.true_body, TICK_S)
        self.tick += 1
        now = self._odometry()
        residual = observed_impulse(self.last, now, self.body) - self.matrix @ asked_N_s
        spread = covariance(self.noise, self.body, self.matrix, asked_N_s, self.last, now)
        mismatch = mismatch_signatures(
            PlantMismatch(), self.body, self.matrix, asked_N_s, self.last, now
        )
        self.last = now
        everyone: Flags = np.ones(len(self.full), dtype=np.bool_)
        return self.watch.update(
            residual,
            spread,
            asked_N_s,
            TICK_S,
            everyone if suspects is None else suspects,
            mismatch,
            self.full if known_N is None else known_N,
        )

    def pulses(self, in_minima: dict[int, float]) -> Array:
        """Impulses of thrusters from those in minimum pulses."""
        shares = [in_minima.get(j, 0.0) for j in range(len(self.least))]
        return self.least * shares

    def random(self, share: float = 0.25) -> Array:
        """Impulses of thrusters, some of which fire."""
        fires = self.rng.uniform(size=len(self.full)) < share
        return np.where(fires, self.full * self.rng.uniform(0.01, 0.05, len(self.full)), 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_observed_impulse_is_what_was_given(seed: int) -> None:
    case = Case("tetra12", seed)
    for _ in range(10):
        thrusters, before = case.random(), case.last
        case.step(thrusters, thrusters)
        seen = observed_impulse(before, case.last, case.body)
        np.testing.assert_allclose(seen, case.matrix @ thrusters, atol=2e-4)


@pytest.mark.parametrize(
    ("body", "thruster"), [("tetra12", j) for j in range(12)] + [("slider", j) for j in range(16)]
)
def test_stuck_on_is_found_within_three_ticks(body: str, thruster: int) -> None:
    case = Case(body, thruster)
    for _ in range(5):
        thrusters = case.random()
        assert case.step(thrusters, thrusters) is None
    verdict = None
    for part in (0.4, 1.0, 1.0):  # the first tick in part only
        asked = case.random(0.1)
        given = asked.copy()
        given[thruster] = max(asked[thruster], case.full[thruster] * TICK_S * part)
        if (verdict := case.step(asked, given)) is not None:
            break
    assert verdict == ThrusterFault(thruster, "stuck_on", 1.0)


@pytest.mark.parametrize(
    ("body", "thruster"), [("tetra12", j) for j in range(12)] + [("slider", j) for j in range(16)]
)
@pytest.mark.parametrize(("left", "kind"), [(0.0, "stuck_off"), (0.5, "weak")])
def test_a_lost_thruster_is_found_after_some_pulses(
    body: str, thruster: int, left: float, kind: str
) -> None:
    case = Case(body, thruster)
    verdict = None
    for _ in range(120):
        asked = case.random()
        given = asked.copy()
        given[thruster] *= left
        if (verdict := case.step(asked, given)) is not None:
            break
    assert verdict is not None
    assert (verdict.thruster, verdict.kind) == (thruster, kind)
    assert verdict.factor == pytest.approx(left, abs=0.15)


@pytest.mark.parametrize("body", ["tetra12", "slider"])
@pytest.mark.parametrize("thruster", [0, 5, 11])
@pytest.mark.parametrize("left", [0.35, 0.6])
def test_a_weak_thruster_that_dies_is_found(body: str, thruster: int, left: float) -> None:
    noise = ImpulseNoise(velocity_m_s=5e-4, omega_rad_s=4e-4)
    case = Case(body, 7 + thruster, noise, odometry_noise=True)
    known, verdicts = np.ones(len(case.full)), list[ThrusterFault]()
    remains = np.ones(len(case.full))
    for tick in range(500):
        remains[thruster] = 1.0 if tick < 30 else left if tick < 300 else 0.0
        asked = case.random()
        verdict = case.step(asked * known, asked * remains, known_N=case.full * known)
        if verdict is not None:
            known[thruster] *= verdict.factor
            case.watch.reset()
            verdicts.append(verdict)
            assert (verdict.kind == "weak") == (tick < 300)
            if verdict.kind != "weak":
                break
    assert {v.thruster for v in verdicts} == {thruster}
    assert [v.kind for v in verdicts] == ["weak", "stuck_off"]


@pytest.mark.parametrize("seed", range(4))
def test_a_thruster_that_worked_until_now_is_stuck_off_and_not_weak(seed: int) -> None:
    """Together with pulses of before, a lost one looks like a part of the thrust."""
    case = Case("tetra12", seed)
    # In minimum pulses, as they fire while a chaser tracks the target.
    firing = [{0: 1.0, 4: 1.5, 8: 1.2, 9: 1.0}, {8: 1.0}, {1: 1.1, 5: 1.2, 7: 1.0, 8: 1.0, 9: 1.0}]
    for pulses in firing:
        asked = case.pulses(pulses)
        assert case.step(asked, asked) is None
    verdict = case.step(case.pulses({8: 1.0, 9: 1.0}), case.pulses({9: 1.0}))
    assert verdict is None
    verdict = case.step(case.pulses({2: 1.0, 8: 1.0}), case.pulses({2: 1.0}))
    assert verdict == ThrusterFault(8, "stuck_off", 0.0)


@pytest.mark.parametrize(
    ("body", "thruster"), [("tetra12", 11), ("tetra12", 4), ("slider", 3), ("slider", 13)]
)
def test_two_equal_burns_tell_that_an_idle_thruster_is_stuck_off(body: str, thruster: int) -> None:
    """A thruster that fires in test burns only fires with the same others, each of whose thrusts
    may differ.
    """
    case = Case(body, thruster)
    allocator, least = allocator_of(case.body), case.least
    only = np.arange(len(least)) == thruster
    burn = ThrusterSelfTest(allocator, least, 1.0, case.watch.ticks_to_tell).schedule(
        0, only, case.full, 0.0 * case.full, 0.1
    )
    assert burn is not None
    asked = np.where(burn > 0.5 * least, burn, 0.0)
    assert case.step(asked, np.where(only, 0.0, asked)) is None  # it may be a disturbance
    assert case.watch.ticks_to_tell(thruster) is None
    verdict = case.step(asked, np.where(only, 0.0, asked))
    assert verdict == ThrusterFault(thruster, "stuck_off", 0.0)
    assert case.watch.ticks_to_tell(thruster) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_no_false_alarm_with_scatter_and_noisy_odometry(seed: int) -> None:
    noise = ImpulseNoise(velocity_m_s=5e-4, omega_rad_s=5e-4)
    case = Case(("tetra12", "slider")[seed % 2], seed, noise, odometry_noise=True)
    for _ in range(1500):
        asked = case.random()
        given = asked * (1.0 + 0.05 * case.rng.normal(size=len(asked)))
        assert case.step(asked, given) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_no_false_alarm_with_another_plant_than_assumed(seed: int) -> None:
    noise = ImpulseNoise(velocity_m_s=5e-4, omega_rad_s=4e-4)
    case = Case("tetra12", seed, noise, odometry_noise=True, mismatched=True)
    for _ in range(600):
        asked = case.random()
        assert case.step(asked, asked) is None


@pytest.mark.parametrize("thruster", range(12))
@pytest.mark.parametrize("left", [0.0, 2.0])
def test_a_failure_is_found_with_another_plant_than_assumed(thruster: int, left: float) -> None:
    noise = ImpulseNoise(velocity_m_s=5e-4, omega_rad_s=4e-4)
    case = Case("tetra12", thruster, noise, odometry_noise=True, mismatched=True)
    verdict = None
    for _ in range(200):
        asked = case.random()
        given = asked.copy()
        given[thruster] = case.full[thruster] * TICK_S if left > 1.0 else 0.0
        if (verdict := case.step(asked, given)) is not None:
            break
    assert verdict is not None
    assert (verdict.thruster, verdict.kind) == (thruster, "stuck_on" if left > 1.0 else "stuck_off")


def test_the_scenarios_odometry_is_the_pilots_noise() -> None:
    s = mission(
        navigation={
            "grade": "exact",
            "velocity_noise_m_s": 0.002,
            "omega_noise_deg_s": 0.1,
            "attitude_noise_deg": 0.3,
        }
    )
    assert noise_of(s.navigation.errors()) == ImpulseNoise(0.002, np.radians(0.1), np.radians(0.3))
    assert noise_of(mission().navigation.errors()) == ImpulseNoise()


@pytest.mark.parametrize("thruster", [0, 4, 8])
def test_noisy_odometry_takes_longer_and_finds_the_same(thruster: int) -> None:
    noise = ImpulseNoise(velocity_m_s=5e-4, omega_rad_s=5e-4)
    case = Case("tetra12", thruster, noise, odometry_noise=True)
    verdict = None
    for _ in range(7):  # half a second, less the latency
        given = np.zeros(12)
        given[thruster] = case.full[thruster] * TICK_S
        if (verdict := case.step(np.zeros(12), given)) is not None:
            break
    assert verdict == ThrusterFault(thruster, "stuck_on", 1.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_bump_or_a_pull_is_no_thruster(seed: int) -> None:
    """A contact pushes as no thruster does: no thruster is reported."""
    case = Case("tetra12", seed)
    rng = np.random.default_rng(seed)
    pull = rng.normal(size=6) * ([0.05] * 3 + [0.002] * 3)
    for k in range(40):
        asked = case.random()
        pushed = np.linalg.lstsq(case.matrix, pull if k % 10 < 6 else np.zeros(6), rcond=None)[0]
        assert case.step(asked, asked + pushed) is None


@pytest.mark.parametrize("seed", range(8))
def test_commands_that_reach_no_valve_are_no_failure(seed: int) -> None:
    """Seed 192 of `docking-contact`: of twelve healthy thrusters three were isolated within two
    seconds.
    """
    case = Case("tetra12", seed, odometry_noise=True)
    for tick in range(120):
        asked = case.random()
        assert case.step(asked, asked if tick < 30 or tick > 90 else np.zeros(12)) is None


def test_only_suspects_are_blamed() -> None:
    case = Case("tetra12", 1)
    suspects = np.arange(12) != 5
    for _ in range(6):
        given = np.zeros(12)
        given[5] = 0.1
        assert case.step(np.zeros(12), given, suspects) is None


def test_residuals_of_white_noise_are_consistent_and_larger_ones_are_not() -> None:
    """Over 10 ticks the energy of noise has 60 degrees of freedom: 60 on average, 115 at five
    sigma.
    """
    assert is_consistent(energy=110.0, explained=0.0, squared=0.0, ticks=10)
    assert not is_consistent(energy=120.0, explained=0.0, squared=0.0, ticks=10)
    assert is_consistent(energy=120.0, explained=10.0, squared=0.0, ticks=10)
