# SPDX-License-Identifier: Apache-2.0
"""Certify passive safety: how far a coast after a total loss of thrust stays from the target.

The target is surrounded by a keep-out sphere. The coast is free motion, or Clohessy-Wiltshire
motion in an orbit (relative_motion.py). Definition: Fehse, Automated Rendezvous and Docking of
Spacecraft, section 4.4 (passive trajectory protection).
"""

from __future__ import annotations

import math
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np

from .arrays import Array, IntArray
from .native import address, function, location, scratch
from .relative_motion import cw_transition

STEP_S = 10.0
"""Step of the samples of a coast; between them the motion is bounded by chord and sagitta."""
# Half of the change of acceleration in a step (1 %) on top of the sagitta |dv| dt / 8 of a constant
# acceleration.
_SAGITTA_SHARE = 1.02 / 8.0


@dataclass(frozen=True)
class CoastCertificate:
    """Closest approach of the coasts from the states of a plan.

    ``margin_sigmas``: smallest distance from the keep-out sphere, in standard deviations along the
    line from the target; negative inside. ``distance_m``: lower bound on the distance from the
    target at that moment. ``time_s``: the moment, counted from the loss of thrust. ``loss``: index
    of the state at which thrust is lost.
    """

    margin_sigmas: float
    distance_m: float
    time_s: float
    loss: int


@dataclass(frozen=True)
class ClosestApproaches:
    """Closest approach of the coast from each of M states.

    ``margin_sigmas``, ``distance_m`` and ``time_s`` (M,), as in ``CoastCertificate``.
    """

    margin_sigmas: Array
    distance_m: Array
    time_s: Array


class CoastModel:
    """Predict coasts of ``duration_s`` by transition matrices, on an orbit with this mean motion.

    A mean motion of 0 stands for free motion. The coast is sampled every ``step_s``; a longer step
    is faster, and its lower bound on the distance smaller.
    """

    def __init__(self, mean_motion_rad_s: float, duration_s: float, step_s: float = STEP_S) -> None:
        self._step_s = duration_s / max(1, math.ceil(duration_s / step_s))
        self._times_s = np.arange(round(duration_s / self._step_s) + 1) * self._step_s
        self._transitions = cw_transition(mean_motion_rad_s, self._times_s)
        rows = self._transitions[:, :3]
        self._by_axis = np.ascontiguousarray(rows.transpose(1, 0, 2))
        # With these the trace of a position's covariance is one product.
        self._squares = (rows.transpose(0, 2, 1) @ rows).reshape(-1, 36)
        # The acceleration of a coast turns with the orbit: in a step it changes by less than n dt
        # of itself.
        self._sagitta_share = max(_SAGITTA_SHARE, (1.0 + mean_motion_rad_s * self._step_s) / 8.0)

    def certify(self, states: Array, covariance: Array, keep_out_m: float) -> CoastCertificate:
        """Return the certificate of the states (M, 6) of a plan: position and velocity relative to
        the target, WRF.

        ``covariance`` (6, 6): of a state's error, the same for all states of the plan.
        """
        columns = self._candidates(states, covariance, keep_out_m)
        found = self._closest_in(columns, states, covariance, keep_out_m)
        loss = int(np.argmin(found.margin_sigmas))
        return CoastCertificate(
            float(found.margin_sigmas[loss]),
            float(found.distance_m[loss]),
            float(found.time_s[loss]),
            loss,
        )

    def closest(self, states: Array, covariance: Array, keep_out_m: float) -> ClosestApproaches:
        """Return the approach of smallest margin of the coast from each of the states (M, 6).

        Arguments as in ``certify``.
        """
        return self._closest_in(np.arange(len(self._times_s) - 1), states, covariance, keep_out_m)

    def tangent_planes(
        self, states: Array, covariance: Array, keep_out_m: float, sigmas: float, count: int
    ) -> Array:
        """Return half-spaces (M, count, 7) that keep the coasts from M states out of the keep-out
        sphere.

        Each is tangent at one of a coast's closest approaches, those with the smallest margins. For
        a row [c (6), d], c' x >= d suffices for a state x (6,) to keep ``sigmas`` standard
        deviations from the keep-out at that moment. c is zero where a coast has fewer approaches.
        Other arguments as in ``certify``.
        """
        coasts = (self._by_axis @ states.T).transpose(2, 1, 0)
        distances = np.sqrt(np.square(coasts).sum(axis=2))
        lines = coasts / np.maximum(distances, 1e-9)[..., None]
        spread = self._transitions[:, :3] @ covariance @ self._transitions[:, :3].transpose(0, 2, 1)
        sigmas_m = np.sqrt(np.maximum(_variance_along(lines, spread), 1e-18))
        margins = (distances - keep_out_m) / sigmas_m
        beside = np.pad(margins, ((0, 0), (1, 1)), constant_values=np.inf)
        lowest = np.where((margins <= beside[:, :-2]) & (margins < beside[:, 2:]), margins, np.inf)
        samples = np.argsort(lowest, axis=1, kind="stable")[:, :count]
        # The closest approach is in the step before or after the sample.
        before, after = (
            self._planes_in(
                np.clip(steps, 0, len(self._times_s) - 2), states, covariance, keep_out_m, sigmas
            )
            for steps in (samples - 1, samples)
        )
        planes = np.where((before[1] < after[1])[..., None], before[0], after[0])
        planes[np.isinf(np.take_along_axis(lowest, samples, axis=1))] = 0.0
        return planes

    def _planes_in(
        self, steps: IntArray, states: Array, covariance: Array, keep_out_m: float, sigmas: float
    ) -> tuple[Array, Array]:
        """Return half-spaces (M, C, 7) of the closest approach within ``steps`` (M, C), and margins
        (M, C).
        """
        parts = self._transitions[steps], self._transitions[steps + 1]
        begin, end = (np.einsum("mcij,mj->mci", part, states) for part in parts)
        here, step = begin[..., :3], end[..., :3] - begin[..., :3]
        length2 = np.maximum(np.einsum("mci,mci->mc", step, step), 1e-30)
        share = np.clip(-np.einsum("mci,mci->mc", here, step) / length2, 0.0, 1.0)[..., None]
        nearest = here + share * step
        chord_m = np.linalg.norm(nearest, axis=2)
        line = np.where((chord_m > 1e-6)[..., None], nearest, _across(step))
        line /= np.linalg.norm(line, axis=2)[..., None]
        bulge_m = (
            self._sagitta_share
            * self._step_s
            * np.linalg.norm(end[..., 3:] - begin[..., 3:], axis=2)
        )
        slopes = [np.einsum("mci,mcij->mcj", line, part[..., :3, :]) for part in parts]
        variances = [np.einsum("mci,ij,mcj->mc", slope, covariance, slope) for slope in slopes]
        sigma_m = np.sqrt(np.maximum(np.maximum(*variances), 1e-18))
        normal = (1.0 - share) * slopes[0] + share * slopes[1]
        bound = keep_out_m + sigmas * sigma_m + bulge_m
        margin = (chord_m - bulge_m - keep_out_m) / sigma_m
        return np.concatenate([normal, bound[..., None]], axis=2), margin

    def _candidates(self, states: Array, covariance: Array, keep_out_m: float) -> IntArray:
        """Return the steps that can contain the smallest margin of the coasts from all states.

        Bounds the distance as in ``_room``, and the standard deviation by the root of the trace of
        the covariance. Arguments as in ``certify``.
        """
        room_m = self._room(states) - keep_out_m
        trace = self._squares @ covariance.ravel()
        sigma_m = np.sqrt(np.maximum(np.maximum(trace[:-1], trace[1:]), 1e-18))
        bound = np.where(room_m > 0.0, room_m / sigma_m, -np.inf)
        first = np.array([np.argmin(bound)])
        least = self._closest_in(first, states, covariance, keep_out_m).margin_sigmas.min()
        return np.flatnonzero(bound <= least + 1e-9 * abs(least))

    def _room(self, states: Array) -> Array:
        """Return lower bounds (T,) on the distance from the target, m, in each step of the coasts.

        ``states`` (M, 6); computed by native/coast.c.
        """
        columns, room = _columns(states), np.empty(len(self._times_s) - 1)
        work = scratch(columns.size)
        function("coast_room")(
            c_int64(len(room)),
            address(self._transitions),
            c_int64(columns.shape[1]),
            address(columns),
            c_double(self._sagitta_share * self._step_s),
            address(room),
            address(work),
        )
        return room

    def _closest_in(
        self, columns: IntArray, states: Array, covariance: Array, keep_out_m: float
    ) -> ClosestApproaches:
        """Return ``closest`` within these steps (L,) of the coasts (native/coast.c)."""
        padded, found = _columns(states), np.empty((3, -(-len(states) // 4) * 4))
        steps, spread = (
            np.ascontiguousarray(columns, dtype=np.int64),
            np.ascontiguousarray(covariance),
        )
        approaches = (c_void_p * 3)(*map(location, found))
        function("coast_closest")(
            c_int64(len(steps)),
            address(steps),
            address(self._transitions),
            c_int64(padded.shape[1]),
            address(padded),
            address(spread),
            c_double(keep_out_m),
            c_double(self._sagitta_share * self._step_s),
            approaches,
        )
        margins, away, moments = found[:, : len(states)]
        return ClosestApproaches(margins, away, moments * self._step_s)


def _columns(states: Array) -> Array:
    """Return states (M, 6) as columns (6, P) for the kernels.

    P is the next multiple of four; the last state is repeated.
    """
    count = -(-len(states) // 4) * 4
    columns = np.empty((6, count))
    columns[:, : len(states)], columns[:, len(states) :] = states.T, states[-1][:, None]
    return columns


def _across(step: Array) -> Array:
    """Return vectors (..., 3) perpendicular to ``step`` (..., 3).

    They stand in for the line from the target where a coast leads through its centre.
    """
    least = np.eye(3)[np.argmin(np.abs(step), axis=-1)]
    side = np.cross(step, least)
    return np.where(np.linalg.norm(side, axis=-1, keepdims=True) > 0.0, side, least)


def _variance_along(line: Array, covariance: Array) -> Array:
    """Return the variances (M, K) along unit vectors (M, K, 3) of covariances (K, 3, 3)."""
    x, y, z = line[..., 0], line[..., 1], line[..., 2]
    a, b, c = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    squares = a[:, 0] * x * x + b[:, 1] * y * y + c[:, 2] * z * z
    return squares + 2.0 * (a[:, 1] * x * y + a[:, 2] * x * z + b[:, 2] * y * z)
