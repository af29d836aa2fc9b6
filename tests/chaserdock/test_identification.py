# SPDX-License-Identifier: Apache-2.0
"""A robot is identified from its recorded motion, with honest standard deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ActuatorCommand, DrawnBody, ThrusterPulse
from chaserdock_protocol.scenario import Scenario, load_scenario
from flight_cases import scenario
from general_position import flown, matrix
from harness import ROOT, finished
from mcap_writers import copy_log
from msgspec.structs import replace
from scipy.stats import chi2

from chaserdock.identification.fit import RobotIdentification, identify, identify_robot
from chaserdock.identification.motion_filter import (
    INERTIA_ROWS,
    MotionFilter,
    Noise,
    RobotParameters,
    actuation_of,
    commanded_over,
)
from chaserdock.identification.recorded import (
    IdentificationError,
    MeasuredMotion,
    Pulses,
    RecordedRobot,
    Wrenches,
)
from chaserdock.identification.report import identification_lines
from chaserdock.logs.reader import open_log
from chaserdock.simulation.flight import fly_case

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
TICK_S, TICK_NS, START_NS = 0.1, 100_000_000, 1_000_000_000
CENTRE = np.array([0.011, -0.008, 0.006])
INERTIA = np.array([[0.36, 0.02, -0.015], [0.02, 0.29, 0.01], [-0.015, 0.01, 0.41]])
PUSH = np.array([0.004, -0.006, 0.003, 4e-4, -3e-4, 5e-4])
SIGMAS = np.repeat([3e-4, 5e-4, 5e-4, 4e-4], 3)


def robot_scenario(**chaser: Any) -> Scenario:
    values = {"mass_kg": 20.0, "inertia_kg_m2": [0.33, 0.33, 0.33], "torque_max_N_m": 0.1}
    return scenario(chaser=values | chaser, time={"rate_hz": 10, "image_hz": 10})


def command(tick: int, wrench: Array, early_ns: int) -> ActuatorCommand:
    return ActuatorCommand(
        seq=tick,
        chaser=0,
        source="command",
        effective_time_ns=START_NS + tick * TICK_NS - early_ns,
        force_N=vector(wrench[:3]),
        torque_N_m=vector(wrench[3:]),
    )


def motion_of(wrenches: Array, mass_kg: float, noise: Array, seed: int) -> MeasuredMotion:
    """Return the measured motion (K + 1) of a body, by definition, under wrenches (K, 6) at the
    origin of CRF that each act for a tick."""
    edges = [(START_NS + k * TICK_NS, 0, 0.0) for k in range(len(wrenches))]
    acting = iter(wrenches)
    return _motion(edges, lambda *_: next(acting), len(wrenches), mass_kg, noise, seed)


def lagging_motion(
    wrenches: Array, delay_s: float, lag_s: float, noise: Array, seed: int
) -> MeasuredMotion:
    """Return the measured motion of a body of 24 kg whose wrench y follows ``wrenches`` (K, 6) late
    by lag y' = w - y, in steps of 5 ms by their mean.
    """
    parts, y = 20, np.zeros(6)
    means = [y] * round(delay_s / TICK_S * parts)
    kept = math.exp(-TICK_S / parts / lag_s)
    for w in np.repeat(wrenches, parts, axis=0):
        means.append(w + (y - w) * (1.0 - kept) * lag_s / (TICK_S / parts))
        y = w + (y - w) * kept
    edges = [(START_NS + k * TICK_NS / parts, k, 0.0) for k in range(len(wrenches) * parts)]
    return _motion(edges, lambda k, _: means[k], len(wrenches), 24.0, noise, seed)


def motion_under(
    edges: Sequence[tuple[float, int, float]], columns: Array, ticks: int, noise: Array, seed: int
) -> MeasuredMotion:
    """Return the measured motion of a body of 24 kg as thrusters with these wrenches (6, n) open
    and close at ``edges``: time, ns, thruster, and 1 or -1.
    """
    opened = np.zeros(columns.shape[1])

    def act(k: int, change: float) -> Array:
        opened[k] += change
        return columns @ opened

    return _motion(edges, act, ticks, 24.0, noise, seed)


def _motion(
    edges: Sequence[tuple[float, int, float]],
    act: Callable[[int, float], Array],
    ticks: int,
    mass_kg: float,
    noise: Array,
    seed: int,
) -> MeasuredMotion:
    rng = np.random.default_rng(seed)
    x = np.zeros(18)
    x[6:15], x[15:] = matrix([0.8, 0.3, -0.4, 0.2]).ravel(), (0.04, -0.05, 0.03)
    rows, coming, wrench = [], 0, np.zeros(6)
    for tick in range(ticks + 1):
        r, w = x[6:15].reshape(3, 3), x[15:]
        e = noise * rng.standard_normal(12)
        turned = rotations.multiply(rotations.from_matrix(r), rotations.exp(e[6:9]))
        place, velocity = x[:3] - r @ CENTRE, x[3:6] - r @ np.cross(w, CENTRE)
        rows.append([*(place + e[:3]), *(velocity + e[3:6]), *turned, *(w + e[9:])])
        now_ns, end_ns = float(START_NS + tick * TICK_NS), float(START_NS + (tick + 1) * TICK_NS)
        while tick < ticks and now_ns < end_ns:
            while coming < len(edges) and edges[coming][0] <= now_ns:
                wrench = act(*edges[coming][1:])
                coming += 1
            until_ns = min(end_ns, edges[coming][0] if coming < len(edges) else end_ns)
            total = wrench + PUSH
            total[3:] -= np.cross(CENTRE, total[:3])
            before = np.concatenate([x[:6], rotations.from_matrix(x[6:15].reshape(3, 3)), x[15:]])
            x = flown(before, mass_kg, INERTIA, total, (until_ns - now_ns) / 1e9)
            now_ns = until_ns
    covariance = np.diag(np.maximum(noise, 1e-7) ** 2)
    time_ns = START_NS + np.arange(len(rows)) * TICK_NS
    return MeasuredMotion(time_ns, np.array(rows), covariance, np.ones(ticks, dtype=bool))


def free_flyer(
    seed: int, ticks: int, noise: Array, late_ns: int = 0, axes: Any = 1.0
) -> RecordedRobot:
    """Return a robot of 24 kg, in general position, whose forces along ``axes`` (6,) are as
    commanded, and later by ``late_ns``."""
    wrenches = commanded_wrenches(seed, ticks) * np.asarray(axes)
    return robot_under(wrenches, motion_of(wrenches, 24.0, noise, seed), late_ns)


def commanded_wrenches(seed: int, ticks: int) -> Array:
    """Return drawn wrenches (ticks, 6) that are held for four ticks each."""
    rng = np.random.default_rng(100 + seed)
    held = np.repeat(rng.uniform(-1.0, 1.0, (ticks // 4 + 1, 6)), 4, axis=0)[:ticks]
    return held * [1.5, 1.5, 1.5, 0.03, 0.03, 0.03]


def robot_under(wrenches: Array, motion: MeasuredMotion, late_ns: int = 0) -> RecordedRobot:
    own = robot_scenario()
    commands = [command(k, w, late_ns) for k, w in enumerate(wrenches)]
    return RecordedRobot(own, 0, motion, Wrenches(own, commands, simulated=True))


TRUE = {
    "mass": 24.0,
    "delay": 0.0,
    **dict(zip(("centre x", "centre y", "centre z"), CENTRE.tolist(), strict=True)),
    **{f"I{'xyz'[i]}{'xyz'[j]}": float(INERTIA[i, j]) for i, j in INERTIA_ROWS},
    **dict(zip(("force x", "force y", "force z"), PUSH[:3].tolist(), strict=True)),
    **dict(zip(("torque x", "torque y", "torque z"), PUSH[3:].tolist(), strict=True)),
}


def test_two_passes_without_noise_find_what_differs() -> None:
    """So every derivative of the motion is right: after the second, third order is left."""
    robot = free_flyer(0, 40, np.zeros(12))
    true = np.array([20.0 / 24.0, *CENTRE, *(INERTIA[e] for e in INERTIA_ROWS), *PUSH, *[0.0] * 5])
    true[4:16] *= 20.0 / 24.0  # the filter counts in units of the stated mass
    scale = np.array([1.0, *[0.01] * 3, *[0.3] * 6, *[0.3] * 3, *[0.03] * 3, 0.1, 0.0, *[1e-9] * 3])
    off = 0.02 * np.random.default_rng(5).choice([-1.0, 1.0], 21)
    own = RobotParameters.of(true + off * scale)
    for _ in range(2):
        commanded = commanded_over(robot.actuators, robot.motion.time_ns, own)
        noise = Noise(np.eye(12) * 1e-10, np.zeros(12), 0.0)
        run = MotionFilter(actuation_of(robot.scenario.chaser), 20.0, own, noise).run
        found = run(robot.motion, commanded, np.zeros(21), scale)
        own = RobotParameters.of(own.vector + found.change)
    assert np.all(np.abs(own.vector - true) < 5e-4 * scale + 1e-9)


@pytest.fixture(scope="module")
def found() -> RobotIdentification:
    return identify_robot(free_flyer(1, 60, SIGMAS))


def test_a_free_flyer_is_identified(found: RobotIdentification) -> None:
    assert [q.name for q in found.quantities if not q.known] == ["lag"]
    for name, value in TRUE.items():
        (q,) = found.named(name)
        assert abs(q.value - value) < 4.0 * q.sigma, q
    assert found.named("mass")[0].sigma < 0.3
    assert found.noise_ratio == pytest.approx([1.0] * 4, abs=0.15)
    assert not found.disturbed


@pytest.mark.slow(1)
def test_standard_deviations_are_those_of_the_errors() -> None:
    """Over 4 seeds, two-sided: chi-square of all values together with their covariance."""
    total = freedoms = 0.0
    for seed in range(4):
        found = identify_robot(free_flyer(seed, 200, SIGMAS))
        order = ["mass", *list(TRUE)[2:], "delay"]
        total += _chi_square(found, TRUE, order)
        freedoms += len(order)
    assert 0.001 < chi2.cdf(total, freedoms) < 0.999, total / freedoms


def thruster_robot(seed: int, ticks: int, share: float) -> tuple[RecordedRobot, dict[str, float]]:
    """Return a robot of thrusters in general position, whose pulses scatter by a ``share`` of
    their widths and end in other ticks than they begin, and its true thrusts, N.
    """
    rng, layout, thrusters = np.random.default_rng(300 + seed), np.random.default_rng(7), []
    for t in load_scenario(ROOT / "scenarios" / "single-thrusters.toml").chaser.thrusters:
        place = np.array(t.position_m) + 0.02 * layout.standard_normal(3)
        turned = rotations.rotate(rotations.exp(0.1 * layout.standard_normal(3)), t.direction)
        values = {"position_m": place.tolist(), "direction": turned.tolist(), "thrust_N": 1.0}
        thrusters.append(values | {"rise_s": 0.0, "fall_s": 0.0, "min_on_s": 0.001})
    own = robot_scenario(
        actuation="thrusters", thrusters=thrusters, force_max_N=0.2, torque_max_N_m=0.02
    )
    true_N = 1.0 + 0.05 * rng.standard_normal(len(thrusters))
    commands, edges = [], []
    for tick in range(ticks):
        pulses = []
        for k in np.flatnonzero(rng.uniform(size=len(thrusters)) < 0.3).tolist():
            width_ns = int(rng.uniform(0.3, 0.7) * TICK_NS)
            open_ns = START_NS + tick * TICK_NS + TICK_NS // 2 + (TICK_NS - width_ns) // 2
            pulses.append(ThrusterPulse(thruster=k, open_ns=open_ns, close_ns=open_ns + width_ns))
            close_ns = open_ns + width_ns * (1.0 + share * rng.standard_normal())
            edges += [(open_ns, k, 1.0), (close_ns, k, -1.0)]
        commands.append(replace(command(tick, np.zeros(6), -TICK_NS // 2), pulses=tuple(pulses)))
    columns = wrench_matrix(own.chaser.thrusters) * true_N
    motion = motion_under(sorted(edges), columns, ticks, SIGMAS, seed)
    robot = RecordedRobot(own, 0, motion, Pulses(own, commands))
    return robot, {f"thruster {k}": float(v) for k, v in enumerate(true_N)}


def _chi_square(
    found: RobotIdentification, true: Mapping[str, float], order: Sequence[str]
) -> float:
    """Return chi-square of the named values, in the order of their covariance."""
    by_name = {q.name: q for q in found.quantities}
    kept = [_row_of(found, name) for name in order]
    error = np.array([by_name[name].value - true[name] for name in order])
    return float(error @ np.linalg.solve(found.covariance[np.ix_(kept, kept)], error))


def _row_of(found: RobotIdentification, name: str) -> int:
    thrusters = len(found.named("thruster"))
    gains = [f"thruster {k}" for k in range(thrusters)] or ["force and torque, share"]
    return ["mass", *gains, *list(TRUE)[2:], "delay"].index(name)


@pytest.mark.slow(1)
def test_standard_deviations_are_honest_where_pulses_scatter() -> None:
    """Over 2 seeds, two-sided, with a scatter of 10 % that dominates the noise of the rates."""
    total = freedoms = 0.0
    for seed in range(2):
        robot, thrusts_N = thruster_robot(seed, 150, 0.1)
        found = identify_robot(robot, mass_kg=24.0)
        assert found.scatter_share == pytest.approx(0.1, abs=0.06)
        order = [*thrusts_N, *list(TRUE)[2:], "delay"]
        total += _chi_square(found, TRUE | thrusts_N, order)
        freedoms += len(order)
    print(f"pulses that scatter: chi-square {total:.1f} of {freedoms:.0f}")
    assert 0.001 < chi2.cdf(total, freedoms) < 0.999, total / freedoms


def test_its_lines_can_be_pasted(found: RobotIdentification, tmp_path: Path) -> None:
    pasted = load_pasted(found, "single", tmp_path)
    values = {q.name: q.value for q in found.quantities}
    assert pasted.chaser.mass_kg == pytest.approx(values["mass"], rel=1e-5)
    assert pasted.chaser.inertia == pytest.approx([values[f"I{a}{a}"] for a in "xyz"], rel=1e-5)
    true = pasted.truth.values_of(0)
    assert true is not None
    assert true.centre_of_mass_m == pytest.approx(CENTRE, abs=0.02)
    assert true.inertia_kg_m2 is not None
    assert true.inertia_kg_m2[3] == pytest.approx(values["Ixy"], rel=1e-5)


def load_pasted(found: RobotIdentification, base: str, folder: Path) -> Scenario:
    lines = identification_lines(found)
    text = "\n".join([f'extends = "{base}"', 'name = "pasted"', *lines[lines.index("") :]])
    (folder / "pasted.toml").write_text(text, encoding="utf-8")
    return load_scenario(folder / "pasted.toml")


def test_a_late_robot_is_late() -> None:
    delay = identify_robot(free_flyer(2, 60, SIGMAS, late_ns=60_000_000)).named("delay")[0]
    assert abs(delay.value - 0.06) < 4.0 * delay.sigma < 0.02


@pytest.mark.slow(1)
def test_lag_is_told_from_delay_with_honest_standard_deviations() -> None:
    """Over 3 seeds, two-sided: 25 ms of lag after 55 ms of delay."""
    total, freedoms, delay_s, lag_s = 0.0, 0, 0.055, 0.025
    true = TRUE | {"delay": delay_s + lag_s}
    for seed in range(3):
        wrenches = commanded_wrenches(seed, 200)
        motion = lagging_motion(wrenches, delay_s, lag_s, SIGMAS, seed)
        found = identify_robot(robot_under(wrenches, motion))
        (lag,) = found.named("lag")
        assert lag.known
        assert abs(lag.value - lag_s) < 4.0 * lag.sigma < 0.02
        order = ["mass", *list(TRUE)[2:], "delay"]
        total += _chi_square(found, true, order) + ((lag.value - lag_s) / lag.sigma) ** 2
        freedoms += len(order) + 1
    print(f"lag and delay: chi-square {total:.1f} of {freedoms}")
    assert 0.001 < chi2.cdf(total, freedoms) < 0.999, total / freedoms


def test_no_lag_is_told_where_there_is_none(found: RobotIdentification) -> None:
    (lag,) = found.named("lag")
    assert not lag.known


def test_what_was_not_excited_is_not_stated() -> None:
    """Torque only: moments and products of inertia are found, no mass."""
    found = identify_robot(free_flyer(3, 60, SIGMAS, axes=[0, 0, 0, 1, 1, 1]))
    assert [q.name for q in found.quantities if not q.known] == ["mass", "lag"]
    for q in found.named("I"):
        assert abs(q.value - TRUE[q.name]) < 4.0 * q.sigma < 0.04, q
    lines = identification_lines(found)
    assert "not observable in this run: mass, lag" in lines
    assert not any(line.startswith(("mass", "mass_kg")) for line in lines)


def test_a_weighed_robot_shows_its_force() -> None:
    found = identify_robot(free_flyer(4, 60, SIGMAS), mass_kg=20.0)
    share = found.named("force and torque")[0]
    assert abs(share.value - 20.0 / 24.0) < 4.0 * share.sigma < 0.05
    assert not found.named("mass")


@pytest.mark.parametrize(
    ("lacking", "chaser", "said"),
    [
        ("", 2, r"no chaser 2; its 2 are 0 to 1"),
        ("chaser/0/actuators", 0, r"chaser 0: no thrust was commanded"),
        ("world/chaser/0/odometry", 0, r"chaser 0: no odometry; the log must hold"),
        ("", 0, r"chaser 0: 1\.2 s in which only its actuators moved it; at least 10 s"),
    ],
)
def test_a_run_that_does_not_serve_is_refused(
    lacking: str, chaser: int, said: str, tmp_path: Path
) -> None:
    log = copy_log(
        GOLDEN, tmp_path / "log.mcap", keep=lambda key, _: not key.endswith(lacking or "-")
    )
    with pytest.raises(IdentificationError, match=said):
        identify(log, chaser)


def test_the_command_says_what_is_wrong() -> None:
    refused = finished("calibrate", str(GOLDEN), "--robot", "5")
    assert refused[0] == 2
    assert refused[1].count("\n") == 1
    assert "no chaser 5" in refused[1]
    assert finished("calibrate", str(GOLDEN), "--mass", "20") == (
        2,
        "chaserdock: --mass: only with --robot\n",
    )
    assert finished("calibrate", str(GOLDEN)) == (
        2,
        "chaserdock: --out: needed for a camera's calibration\n",
    )


def flight_errors(log: Path, scenario: Scenario) -> tuple[Array, Array, RobotIdentification]:
    """Return the errors of all that a flight of a weighed chaser tells, their covariance, and what
    it tells."""
    opened = open_log(log)
    drawn = next(iter(opened.messages(topics.TRUTH_DRAWN))).bodies
    true: DrawnBody = next(b for b in drawn if b.body == "chaser/0")
    found = identify(log, 0, true.mass_kg)
    assert all(q.known for q in found.quantities)
    turns = np.reshape(true.thrust_turn_rad, (-1, 3))
    thrusts = {
        f"thruster {k}": t.thrust_N
        * (1.0 + true.thrust_share[k])
        * float(np.dot(rotations.rotate(rotations.exp(turns[k]), t.direction), t.direction))
        for k, t in enumerate(scenario.chaser.thrusters)
    }
    inertia = np.reshape(true.inertia_kg_m2, (3, 3))
    values = thrusts | {"delay": scenario.truth.mismatch("chaser").delay_s}
    for name, vector3 in (
        ("centre", true.centre_of_mass_m),
        ("force", true.force_N),
        ("torque", true.torque_N_m),
    ):
        values |= {f"{name} {axis}": v for axis, v in zip("xyz", vector3, strict=True)}
    values |= {f"I{'xyz'[i]}{'xyz'[j]}": float(inertia[i, j]) for i, j in INERTIA_ROWS}
    order = [
        *thrusts,
        *(q.name for q in found.named("centre")),
        *(q.name for q in found.named("I")),
        *(q.name for q in found.named("force") + found.named("torque")),
        "delay",
    ]
    by_name = {q.name: q for q in found.quantities}
    scale = np.array(
        [scenario.chaser.thrusters[0].thrust_N] * len(thrusts) + [1.0] * (len(order) - len(thrusts))
    )
    error = np.array([by_name[name].value - values[name] for name in order]) / scale
    count = len(thrusts)
    planar = scenario.chaser.is_planar
    kept = [*range(1, 3 + count), *([] if planar else [3 + count])]
    kept += [6 + count] if planar else list(range(4 + count, 10 + count))
    kept += [10 + count, 11 + count, 15 + count] if planar else list(range(10 + count, 16 + count))
    kept.append(16 + count)
    return error, found.covariance[np.ix_(kept, kept)], found


FLOWN = 1
"""Seeds of each scenario; docs/evidence/laboratory.md has the figures of five."""
FLIGHTS = {
    "single-thrusters": {
        "duration_s": 60.0,
        "truth": {"preset": "mismatch", "chaser": {"inertia_turn_deg": 5.0, "delay_s": 0.008}},
        "timeline": [{"at_s": 12.0, "command": "calibrate", "chasers": [0]}],
    },
    "planar-tracking": {},
}


@pytest.mark.slow(5)
@pytest.mark.parametrize("name", FLIGHTS)
def test_flights_tell_the_robot_within_the_standard_deviations(name: str, tmp_path: Path) -> None:
    """Seeds with bodies, thrusters and odometry of their own: each value within four standard
    deviations, and chi-square of all together within a two-sided band of 1 in 500."""
    total = freedoms = 0.0
    for seed in range(1, FLOWN + 1):
        folder = tmp_path / str(seed)
        case = {"extends": name, "name": f"identified-{seed}", "seed": seed, **FLIGHTS[name]}
        fly_case(case, seed, folder)
        scenario = open_log(folder / "run").scenario
        error, covariance, found = flight_errors(folder / "run", scenario)
        assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(covariance)))
        total += float(error @ np.linalg.solve(covariance, error))
        freedoms += len(error)
        load_pasted(found, name, tmp_path)
    print(f"{name}: chi-square {total:.1f} of {freedoms:.0f}")
    assert 0.001 < chi2.cdf(total, freedoms) < 0.999, total / freedoms
