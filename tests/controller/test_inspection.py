# SPDX-License-Identifier: Apache-2.0
"""Inspection: the flight around the target, and the fusion of the information of its images on the
geometry.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.target_shape import (
    FLOOR_SIGMAS,
    SeenPlace,
    ShapeFilter,
    view_cell,
)
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.trajectories import circuit
from chaserdock_controller.ingest.odometry_validation import OdometryValidation
from chaserdock_controller.redundancy.checkpoint import Checkpoint
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import load_scenario
from flight_cases import at, fleet_of, scenario, step, tick_inputs
from harness import ROOT

SECTION = {"distance_m": 1.1, "speed_m_s": 0.1, "axis": [1.0, 2.0, 2.0]}


def machine(**changes: Any) -> ChaserFleet:
    return fleet_of(scenario(inspection=SECTION, **changes), acquired_s=0.0)


def command(guidance: ChaserFleet, now_s: float, *chasers: int) -> list[Any]:
    commands = [OperatorCommand(command="inspect", chaser=i) for i in chasers]
    return guidance.apply(commands, now_s)


def test_circuit_is_smooth_slow_and_returns_to_its_direction() -> None:
    start, speed = np.array([0.0, -1.3, 0.4]), 0.1
    move = circuit(start, (1.0, 1.0, 1.0), 1.1, 5.0, speed)
    times = np.linspace(5.0, 5.0 + move.duration_s, 4001)
    p, v, a = move.at(times)
    step = times[1] - times[0]
    np.testing.assert_allclose(np.gradient(p, step, axis=0)[1:-1], v[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(v, step, axis=0)[1:-1], a[1:-1], atol=1e-5)
    assert np.linalg.norm(v, axis=1).max() <= 1.02 * speed
    np.testing.assert_allclose(p[0], start, atol=1e-12)
    np.testing.assert_allclose(p[-1], start * 1.1 / np.linalg.norm(start), atol=1e-9)
    np.testing.assert_allclose(move.goal_m, p[-1], atol=1e-9)
    for k in (0, -1):
        np.testing.assert_allclose([v[k], a[k]], 0.0, atol=1e-9)
    distances = np.linalg.norm(p, axis=1)
    np.testing.assert_allclose(distances[1100:], 1.1, atol=1e-9)
    assert distances.min() > 1.0999


def test_chasers_inspect_together_keep_their_distance_face_the_target_and_hold_afterwards() -> None:
    guidance = machine()
    assert all(r.accepted for r in command(guidance, 10.0, 0, 1))
    assert [c.phase for c in guidance.chasers] == ["inspect", "inspect"]
    assert all(c.state.faces for c in guidance.chasers)
    end = max(c.state.move.start_s + c.state.move.duration_s for c in guidance.chasers)
    for t in np.linspace(10.0, end, 200):
        a, b = (at(c.state.move, t)[0] for c in guidance.chasers)
        assert np.linalg.norm(a - b) > 1.0
    for i in (0, 1):
        step(guidance.chasers[i], end - 0.1, 0.0, 0.0)
        assert guidance.chasers[i].phase == "inspect"
        step(guidance.chasers[i], end, 0.0, 0.0)
    assert [c.phase for c in guidance.chasers] == ["hold", "hold"]
    assert not any(c.state.faces for c in guidance.chasers)
    np.testing.assert_allclose(
        at(guidance.chasers[0].state.move, end + 9.0)[0], [-1.1, 0.0, 0.0], atol=1e-9
    )


def test_inspection_is_refused_with_the_reason() -> None:
    guidance = machine()
    (reply,) = command(guidance, 10.0, 0)
    assert reply.accepted
    (reply,) = command(guidance, 12.0, 1)
    assert not reply.accepted
    assert "command all of them at one time" in reply.reason
    # About the axis of symmetry of both chasers, the one passes where the other holds.
    crossing = fleet_of(scenario(inspection=SECTION | {"axis": [0.0, 0.0, 1.0]}), acquired_s=0.0)
    (reply,) = command(crossing, 10.0, 0)
    assert not reply.accepted
    assert "m of chaser 1" in reply.reason
    near = fleet_of(scenario(inspection=SECTION | {"distance_m": 0.1}), acquired_s=0.0)
    (reply,) = command(near, 10.0, 0)
    assert "the offset is 0.1 m from the target" in reply.reason
    far = fleet_of(scenario(inspection=SECTION | {"distance_m": 0.45}), acquired_s=0.0)
    (reply,) = command(far, 10.0, 0)
    assert "less than twice inspection.distance_m" in reply.reason


def views(true: Array, count: int, seed: int) -> list[tuple[Array, Array, Array]]:
    """Return directions, information and vectors of views that each measure three combinations of
    the parameters.
    """
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        rows = 4.0 * rng.normal(size=(3, len(true)))
        direction = rng.normal(size=3)
        measured = rows @ true + rng.normal(size=3)
        made.append((direction / np.linalg.norm(direction), rows.T @ rows, rows.T @ measured))
    return made


def test_fusion_is_accurate_and_consistent_and_grows_with_coverage() -> None:
    nees, fused = [], ShapeFilter.prior(7)
    for seed in range(40):
        true = np.random.default_rng([seed, 1]).normal(size=7)
        fused, spreads = ShapeFilter.prior(7), []
        for view in views(true, 30, seed):
            fused = fused.with_view(*view)
            spreads.append(np.trace(fused.covariance()))
        off = fused.mean() - true
        plain = np.linalg.inv(fused.information)
        free = plain @ fused.vector - true
        nees.append(free @ np.linalg.solve(plain, free) / 7.0)
        assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(fused.covariance())))
        assert fused.coverage == len(fused.cells) / 80
        assert np.all(np.diff(spreads) < 1e-9)
        assert spreads[-1] < 0.1 * spreads[0]
    assert 0.7 < np.mean(nees) < 1.3
    least = FLOOR_SIGMAS**2 / (1.0 + FLOOR_SIGMAS**2)
    assert np.all(np.linalg.eigvalsh(fused.covariance()) >= least)


def test_a_direction_counts_once_and_a_contradiction_not_at_all() -> None:
    true = np.array([1.0, -0.5])
    matrix = 25.0 * np.eye(2)
    fused = ShapeFilter.prior(2).with_view(np.array([1.0, 0.0, 0.0]), matrix, matrix @ true)
    known = 1.0 / (1.0 / 25.0 + FLOOR_SIGMAS**2)
    np.testing.assert_allclose(fused.mean(), true * known / (known + 1.0))
    near = np.array([0.999, 0.02, 0.0])
    assert view_cell(near / np.linalg.norm(near)) == view_cell(np.array([1.0, 0.0, 0.0]))
    assert fused.with_view(near / np.linalg.norm(near), matrix, matrix @ true) is fused
    away = np.array([0.0, 0.0, 1.0])
    assert fused.with_view(away, matrix, matrix @ (true + 9.0)) is fused
    assert len(fused.with_view(away, matrix, matrix @ true).cells) == 2


def place(at: Array, true: float, rng: np.random.Generator) -> SeenPlace:
    """Return a place seen with a scale that is wrong by ``true`` of 0.3 % and a panel angle that is
    not.
    """
    towards, by_errors = at / np.linalg.norm(at), np.zeros((3, 2))
    by_errors[:, 1] = 0.003 * at
    seen = at * (1.0 - 0.003 * true) + rng.normal(0.0, 2e-4, 3)
    return SeenPlace(seen, by_errors, 4e-8 * np.eye(3), view_cell(towards))


def test_distances_between_cameras_tell_the_scale_consistently() -> None:
    rng, common_m, nees, sigmas = np.random.default_rng(5), 7e-4, [], []
    for _ in range(200):
        true, common = rng.normal(), rng.normal(0.0, common_m)
        fused = ShapeFilter.prior(2)
        for _ in range(12):
            a = rng.normal(size=3)
            a /= np.linalg.norm(a)
            b = -1.3 * a + rng.normal(0.0, 0.1, 3)
            length = np.linalg.norm(a - b) + common + rng.normal(0.0, 7e-4)
            fused = fused.with_baseline(
                place(a, true, rng), place(b, true, rng), float(length), 7e-4, common_m
            )
        off, covariance = fused.mean() - (0.0, true), fused.covariance()
        nees.append(off[1] ** 2 / covariance[1, 1])
        sigmas.append(0.003 * np.sqrt(covariance[1, 1]))
        assert len(fused.pairs) >= 9
        assert not fused.cells
    assert 0.75 < np.mean(nees) < 1.25
    # What all distances have in common limits it: 0.7 mm of 2.3 m.
    assert 0.0003 < np.mean(sigmas) < 0.0004


def test_a_baseline_counts_once_and_a_short_or_contradicting_one_not_at_all() -> None:
    rng = np.random.default_rng(6)
    a, b = place(np.array([1.0, 0.0, 0.0]), 1.0, rng), place(np.array([-1.0, 0.2, 0.0]), 1.0, rng)
    length = float(np.linalg.norm(np.subtract([1.0, 0.0, 0.0], [-1.0, 0.2, 0.0])))
    fused = ShapeFilter.prior(2).with_baseline(a, b, length, 5e-4, 1e-4)
    assert fused.mean()[1] == pytest.approx(1.0, abs=0.35)
    assert fused.with_baseline(b, a, length, 5e-4, 1e-4) is fused
    c = place(np.array([0.0, 1.0, 0.0]), 1.0, rng)
    assert fused.with_baseline(a, c, 1.5, 5e-4, 1e-4) is fused
    near = place(np.array([0.98, 0.2, 0.0]), 1.0, rng)
    assert fused.with_baseline(a, near, 0.2, 5e-4, 1e-4) is fused
    assert fused.with_baseline(a, c, float(np.sqrt(2.0)), 5e-4, 1e-4) is not fused


@pytest.fixture(scope="module")
def markerless() -> ControllerCore:
    return ControllerCore(
        load_scenario(ROOT / "scenarios/markerless-docking.toml"), now_s=lambda: 0.0
    )


def validations(core: ControllerCore) -> list[OdometryValidation]:
    return [OdometryValidation(core.scenario) for _ in core.scenario.chasers]


def test_standby_takes_over_the_estimate(markerless: ControllerCore) -> None:
    shape = markerless.estimation.shape
    assert shape is not None
    assert [p.name for p in shape.parameters][-2:] == ["scale", "rim"]
    k = len(shape.parameters)
    shape.filter = ShapeFilter.prior(k).with_view(np.array([1.0, 0.0, 0.0]), np.eye(k), np.ones(k))
    checkpoint = Checkpoint(markerless, validations(markerless))
    saved = checkpoint.save()
    shape.filter = ShapeFilter.prior(k)
    checkpoint.restore(saved)
    np.testing.assert_array_equal(shape.filter.vector, np.ones(k))
    assert shape.filter.cells


def test_images_count_once_guidance_has_let_their_chaser_inspect(
    markerless: ControllerCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Estimation of a tick uses the phases after the tick before; a standby takes them over."""
    flight = ControllerCore(markerless.scenario, now_s=lambda: 0.0)
    shape = flight.estimation.shape
    assert shape is not None
    used: list[frozenset[int]] = []
    monkeypatch.setattr(shape, "update", lambda _, inspecting: used.append(inspecting))
    chaser = flight.guidance.chasers[1]
    for tick in range(4):
        if tick == 1:
            chaser.state = replace(chaser.state, phase=Phase.INSPECT)
        if tick == 3:
            chaser.state = replace(chaser.state, phase=Phase.HOLD)
        now_ns = flight.scenario.timing.tick_time_ns(tick)
        flight.step(tick_inputs(tick, now_ns, {}, ()))
    assert used == [frozenset(), frozenset(), {1}, {1}]
    flight.inspecting = frozenset({0})
    saved = Checkpoint(flight, validations(flight)).save()
    Checkpoint(markerless, validations(markerless)).restore(saved)
    assert markerless.inspecting == {0}


def test_targets_with_markers_have_no_geometry_to_estimate() -> None:
    assert ControllerCore(scenario(), now_s=lambda: 0.0).estimation.shape is None
