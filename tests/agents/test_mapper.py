# SPDX-License-Identifier: Apache-2.0
"""Motion and map of a target of unknown shape, from points in general position."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_agents.mapper.adjustment import right_jacobian
from chaserdock_agents.mapper.mapper import Mapper, MapperTuning, TargetMap
from chaserdock_agents.mapper.starting import StartTuning, candidate_motions
from chaserdock_agents.mapper.types import ConstantRates, ImageTracks
from chaserdock_models import rotations
from unknown_cases import FOCAL_PX, LAB, NOISE_PX, TRUE, PointTarget

WHITE = MapperTuning(noise_px=NOISE_PX, open_factor=1.0)
"""For points whose errors are independent, unlike those of tracks in images."""
FEW = StartTuning(directions=14, rates_rad_s=(0.05,), steps=10, pair_tracks=60)
"""Fewer starts, for time."""
SLIDE_PX_S = 0.15
"""Standard deviation of how fast points slide."""


def mapped(target: PointTarget, until_s: float, tuning: MapperTuning = WHITE) -> list[TargetMap]:
    """Return the maps of updates every two seconds."""
    return maps_of(target.images(until_s), target.chasers, tuning, 2.0)


def maps_of(
    images: Iterable[ImageTracks], chasers: int, tuning: MapperTuning, period_s: float
) -> list[TargetMap]:
    """Return the maps of updates every ``period_s``, from 4 s on."""
    mapper = Mapper([LAB] * chasers, FOCAL_PX, tuning, FEW)
    out: list[TargetMap] = []
    next_s = 4.0
    for image in images:
        mapper.add(image)
        if image.chaser == chasers - 1 and image.time_s >= next_s - 1e-6:
            out.append(mapper.update(image.time_s))
            next_s += period_s
    return out


def error_of(found: TargetMap) -> np.ndarray:
    """Return the errors of velocity and rate (6,), in the axes of WRF at the map's time."""
    assert found.motion is not None
    return np.concatenate(
        [found.motion.velocity_m_s - TRUE.velocity_m_s, found.motion.omega_rad_s - TRUE.omega_rad_s]
    )


@pytest.mark.slow(0.2)
def test_motion_is_recovered_with_a_consistent_covariance() -> None:
    nees, shares = [], []
    for seed in range(4):
        found = mapped(PointTarget(seed), 16.0)[-1]
        assert found.status == "mapped"
        error = error_of(found)
        nees.append(float(error @ np.linalg.solve(found.covariance[3:, 3:], error)))
        shares.append(np.linalg.norm(error[3:]) / np.linalg.norm(TRUE.omega_rad_s))
    # Of 6, less two fifths: points with large residuals count for less.
    assert 1.5 < np.mean(nees) < 9.0
    assert max(shares) < 0.01


def sliding(target: PointTarget, until_s: float) -> list[ImageTracks]:
    """Return images whose points slide while they are followed, each in its own direction."""
    slides = np.random.default_rng(target.seed).normal(0.0, SLIDE_PX_S / FOCAL_PX, (10000, 2))
    since: dict[tuple[int, int], float] = {}
    out = []
    for image in target.images(until_s):
        begin = [since.setdefault((image.chaser, i), image.time_s) for i in image.ids.tolist()]
        ages_s = image.time_s - np.array(begin)
        rays = image.rays + slides[image.ids] * ages_s[:, None]
        out.append(replace(image, rays=rays, ages_s=ages_s))
    return out


@pytest.mark.slow(0.2)
def test_points_that_slide_leave_the_motion_consistent() -> None:
    nees = []
    for slide_px in (SLIDE_PX_S / float(np.linalg.norm(TRUE.omega_rad_s)), 1e-3):
        tuning = replace(WHITE, slide_px=slide_px, slide_px_s=0.0)
        found = []
        for seed in range(2):
            last = maps_of(sliding(PointTarget(seed), 16.2), 2, tuning, 4.0)[-1]
            error = error_of(last)
            found.append(float(error @ np.linalg.solve(last.covariance[3:, 3:], error)))
        nees.append(np.mean(found))
    # Of 6; the second mapper takes the points for fixed ones.
    assert nees[0] < 12.0
    assert nees[1] > 2.0 * nees[0]


@pytest.mark.slow(0.1)
def test_landmarks_lie_where_the_points_are() -> None:
    found = mapped(PointTarget(3), 10.0)[-1]
    assert found.motion is not None
    radius = np.linalg.norm(found.landmarks_m + found.motion.position_w_m
                            - TRUE.at([found.motion.time_s])[0][0], axis=1)  # fmt: skip
    assert len(radius) > 60
    # The origin may lie anywhere along the axis: compare the extents.
    assert 0.8 < np.ptp(found.landmarks_m, axis=0).max() < 1.1
    sigma = np.sqrt(np.linalg.eigvalsh(found.covariances_m2)[:, -1])
    assert np.median(sigma) < 0.02


def test_wrong_starts_have_a_larger_cost_than_the_right_one() -> None:
    images = [i for i in PointTarget(1).images(8.0) if i.time_s > 1.9]
    windows = [[i for i in images if i.chaser == c] for c in (0, 1)]
    found = candidate_motions(windows, FOCAL_PX, np.zeros(3), np.zeros(3), 5.0)
    off = [np.linalg.norm(m.omega_rad_s - TRUE.omega_rad_s) for _, m in found]
    assert off[0] < 0.1 * np.linalg.norm(TRUE.omega_rad_s)
    assert all(cost > 1.5 * found[0][0] for cost, _ in found[1:])


@pytest.mark.slow(0.1)
def test_tracks_that_no_rigid_motion_explains_give_no_map() -> None:
    mapper, rng = Mapper([LAB] * 2, FOCAL_PX, WHITE, FEW), np.random.default_rng(0)
    drift = rng.normal(0.0, 0.012, (10000, 2))
    for image in PointTarget(2).images(9.0):
        mapper.add(replace(image, rays=image.rays + drift[image.ids] * image.time_s))
    assert {mapper.update(t).motion is None for t in (8.0, 9.0)} == {True}


@pytest.mark.slow(0.1)
def test_one_chaser_tells_no_scale() -> None:
    found = mapped(PointTarget(4, chasers=1), 12.0)[-1]
    assert found.status in ("scale unknown", "ambiguous")
    assert found.scale_share > WHITE.scale_share


def test_a_target_without_texture_is_named() -> None:
    assert {m.status for m in mapped(PointTarget(5, points=40), 8.0)} == {"no texture"}


def test_a_target_that_does_not_turn_is_named() -> None:
    still = ConstantRates(0.0, TRUE.position_w_m, TRUE.velocity_m_s, np.full(3, 1e-5))
    found = mapped(PointTarget(6, motion=still), 8.0)
    assert {m.status for m in found} == {"does not turn"}


def test_memory_is_bounded() -> None:
    tuning = replace(WHITE, most_views=20)
    mapper = Mapper([LAB] * 2, FOCAL_PX, tuning)
    for image in PointTarget(7, points=10).images(200.0):
        mapper.add(image)
    assert all(len(views) <= 20 for views in mapper.kept_views())
    assert all(views[0].time_s < 20.0 for views in mapper.kept_views())


def test_a_view_that_shows_both_parts_of_a_landmark_counts_once() -> None:
    mapper = Mapper([LAB] * 2, FOCAL_PX, WHITE, FEW)
    for image in PointTarget(9, points=120).images(6.0):
        mapper.add(image)
    one, other = mapper.kept_views()[0][5].ids[:2].tolist()
    mapper.merges.join(one, other)
    _, seen, _ = mapper.observations()
    assert len(set(zip(seen.view.tolist(), seen.landmark.tolist(), strict=True))) == len(seen.view)


@pytest.mark.slow(0.1)
def test_equal_tracks_give_equal_maps() -> None:
    one, other = (mapped(PointTarget(8), 8.0)[-1] for _ in range(2))
    assert np.array_equal(one.landmarks_m, other.landmarks_m)
    assert np.array_equal(one.covariance, other.covariance)


def test_right_jacobian_is_the_derivative_of_the_exponential() -> None:
    phi, step = np.array([[0.7, -1.1, 0.4], [1e-6, 0.0, 2e-6]]), np.array([2e-6, -1e-6, 3e-6])
    moved = rotations.log(
        rotations.multiply(rotations.conjugate(rotations.exp(phi)), rotations.exp(phi + step))
    )
    assert np.allclose(moved, right_jacobian(phi) @ step, atol=1e-11)


def test_images_of_one_chaser_are_thinned_by_age() -> None:
    mapper = Mapper([LAB], FOCAL_PX, WHITE)
    empty = np.zeros(0)
    for k in range(300):
        mapper.add(
            ImageTracks(0, 0.2 * k, np.zeros(3), np.eye(3), empty.astype(np.int64),
                        np.zeros((0, 2)), empty)
        )  # fmt: skip
    times = np.array([v.time_s for v in mapper.kept_views()[0]])
    old = np.diff(times[times < times[-1] - WHITE.recent_s])
    assert old.min() > WHITE.period_s - 1e-6
    assert np.allclose(np.diff(times[-10:]), WHITE.recent_period_s)
