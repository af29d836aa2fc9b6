# SPDX-License-Identifier: Apache-2.0
"""Certify passive safety: how far a coast after a total loss of thrust stays from the target.

The target is surrounded by a keep-out sphere. The coast is free motion, or Clohessy-Wiltshire
motion in an orbit (relative_motion.py), under a constant acceleration by what disturbs the chaser.
Its covariance is that of the state and of this acceleration, and grows by process noise. Definition
of passive safety: Fehse, Automated Rendezvous and Docking of Spacecraft, section 4.4 (passive
trajectory protection).
"""

from __future__ import annotations

import math
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np

from .arrays import Array, IntArray
from .native import address, function, location, scratch
from .relative_motion import cw_matrix, cw_response, cw_transition

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


@dataclass(frozen=True, eq=False)
class DisturbedMotion:
    """What is known of a chaser's motion besides the state from which a coast begins.

    ``acceleration_m_s2`` (3,): by disturbances, WRF; it lasts for the whole coast. ``covariance``
    (9, 9): of the errors of position and velocity relative to the target, and of this acceleration.
    """

    acceleration_m_s2: Array
    covariance: Array


def disturbed(covariance: Array, sigma_m_s2: float = 0.0) -> DisturbedMotion:
    """Return what is known of a motion with a ``covariance`` (6, 6) of position and velocity, if
    only the size of the disturbance is known.

    ``sigma_m_s2``: standard deviation of the acceleration along each axis.
    """
    whole = np.zeros((9, 9))
    whole[:6, :6], whole[range(6, 9), range(6, 9)] = covariance, sigma_m_s2**2
    return DisturbedMotion(np.zeros(3), whole)


@dataclass(frozen=True)
class CoastNoise:
    """Process noise of a coast, per axis.

    ``white_m_s2_sqrt_s``: square root of the spectral density of a white relative acceleration.
    ``varying_m_s2``: standard deviation of a Gauss-Markov acceleration of correlation time
    ``varying_s``. It begins at zero: it is the change since thrust was lost.
    """

    white_m_s2_sqrt_s: float = 0.0
    varying_m_s2: float = 0.0
    varying_s: float = math.inf


class CoastModel:
    """Predict coasts of ``duration_s`` by transition matrices, on an orbit with this mean motion.

    A mean motion of 0 stands for free motion. The coast is sampled every ``step_s``; a longer step
    is faster, and its lower bound on the distance smaller.
    """

    def __init__(
        self,
        mean_motion_rad_s: float,
        duration_s: float,
        step_s: float = STEP_S,
        noise: CoastNoise = CoastNoise(),
    ) -> None:
        self._step_s = duration_s / max(1, math.ceil(duration_s / step_s))
        self._times_s = np.arange(round(duration_s / self._step_s) + 1) * self._step_s
        self._transitions = cw_transition(mean_motion_rad_s, self._times_s)
        self._responses = cw_response(mean_motion_rad_s, self._times_s)
        # Positions (T, 3, 9) by state and acceleration, and their covariance (T, 3, 3) by noise.
        self._rows = np.concatenate([self._transitions[:, :3], self._responses[:, :3]], axis=2)
        self._by_axis = np.ascontiguousarray(self._rows.transpose(1, 0, 2))
        self._noise = coast_covariance(mean_motion_rad_s, self._step_s, len(self._times_s), noise)
        # With these the trace of a position's covariance is one product.
        self._squares = (self._rows.transpose(0, 2, 1) @ self._rows).reshape(-1, 81)
        self._noise_trace = np.trace(self._noise, axis1=1, axis2=2)
        # The acceleration of a coast turns with the orbit: in a step it changes by less than n dt
        # of itself.
        self._sagitta_share = max(_SAGITTA_SHARE, (1.0 + mean_motion_rad_s * self._step_s) / 8.0)

    def certify(
        self, states: Array, motion: DisturbedMotion, keep_out_m: float
    ) -> CoastCertificate:
        """Return the certificate of the states (M, 6) of a plan: position and velocity relative to
        the target, WRF.

        ``motion``: the same for all states of the plan.
        """
        columns = self._candidates(states, motion, keep_out_m)
        found = self._closest_in(columns, states, motion, keep_out_m)
        loss = int(np.argmin(found.margin_sigmas))
        return CoastCertificate(
            float(found.margin_sigmas[loss]),
            float(found.distance_m[loss]),
            float(found.time_s[loss]),
            loss,
        )

    def closest(
        self, states: Array, motion: DisturbedMotion, keep_out_m: float
    ) -> ClosestApproaches:
        """Return the approach of smallest margin of the coast from each of the states (M, 6).

        Arguments as in ``certify``.
        """
        return self._closest_in(np.arange(len(self._times_s) - 1), states, motion, keep_out_m)

    def tangent_planes(
        self, states: Array, motion: DisturbedMotion, keep_out_m: float, sigmas: float, count: int
    ) -> Array:
        """Return half-spaces (M, count, 7) that keep the coasts from M states out of the keep-out
        sphere.

        Each is tangent at one of a coast's closest approaches, those with the smallest margins. For
        a row [c (6), d], c' x >= d suffices for a state x (6,) to keep ``sigmas`` standard
        deviations from the keep-out at that moment. c is zero where a coast has fewer approaches.
        Other arguments as in ``certify``.
        """
        pushed = np.tile(motion.acceleration_m_s2, (len(states), 1))
        coasts = (self._by_axis @ np.hstack([states, pushed]).T).transpose(2, 1, 0)
        distances = np.sqrt(np.square(coasts).sum(axis=2))
        lines = coasts / np.maximum(distances, 1e-9)[..., None]
        spread = self._spread(np.arange(len(self._times_s)), motion)
        sigmas_m = np.sqrt(np.maximum(_variance_along(lines, spread), 1e-18))
        margins = (distances - keep_out_m) / sigmas_m
        beside = np.pad(margins, ((0, 0), (1, 1)), constant_values=np.inf)
        lowest = np.where((margins <= beside[:, :-2]) & (margins < beside[:, 2:]), margins, np.inf)
        samples = np.argsort(lowest, axis=1, kind="stable")[:, :count]
        # The closest approach is in the step before or after the sample.
        before, after = (
            self._planes_in(
                np.clip(steps, 0, len(self._times_s) - 2), states, motion, keep_out_m, sigmas
            )
            for steps in (samples - 1, samples)
        )
        planes = np.where((before[1] < after[1])[..., None], before[0], after[0])
        planes[np.isinf(np.take_along_axis(lowest, samples, axis=1))] = 0.0
        return planes

    def _planes_in(
        self,
        steps: IntArray,
        states: Array,
        motion: DisturbedMotion,
        keep_out_m: float,
        sigmas: float,
    ) -> tuple[Array, Array]:
        """Return half-spaces (M, C, 7) of the closest approach within ``steps`` (M, C), and margins
        (M, C).
        """
        ends, drift = (steps, steps + 1), self._drift(motion)
        begin, end = (
            np.einsum("mcij,mj->mci", self._transitions[k], states) + drift[k] for k in ends
        )
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
        slopes = [np.einsum("mci,mcij->mcj", line, self._rows[k]) for k in ends]
        variances = [
            np.einsum("mci,ij,mcj->mc", slope, motion.covariance, slope)
            + np.einsum("mci,mcij,mcj->mc", line, self._noise[k], line)
            for slope, k in zip(slopes, ends, strict=True)
        ]
        sigma_m = np.sqrt(np.maximum(np.maximum(*variances), 1e-18))
        normal = (1.0 - share) * slopes[0] + share * slopes[1]
        bound = keep_out_m + sigmas * sigma_m + bulge_m - normal[..., 6:] @ motion.acceleration_m_s2
        margin = (chord_m - bulge_m - keep_out_m) / sigma_m
        return np.concatenate([normal[..., :6], bound[..., None]], axis=2), margin

    def _drift(self, motion: DisturbedMotion) -> Array:
        """Return the states (T, 6) that the disturbance adds to a coast."""
        moved = self._responses.reshape(-1, 3) @ motion.acceleration_m_s2
        return moved.reshape(-1, 6)

    def _spread(self, samples: IntArray, motion: DisturbedMotion) -> Array:
        """Return the covariances (K, 3, 3) of the position at samples (K,) of a coast."""
        rows = self._rows[samples]
        moved = (rows.reshape(-1, 9) @ motion.covariance).reshape(rows.shape)
        return np.einsum("kin,kjn->kij", moved, rows) + self._noise[samples]

    def _candidates(self, states: Array, motion: DisturbedMotion, keep_out_m: float) -> IntArray:
        """Return the steps that can contain the smallest margin of the coasts from all states.

        Bounds the distance as in ``_room``, and the standard deviation by the root of the trace of
        the covariance. Arguments as in ``certify``.
        """
        room_m = self._room(states, self._drift(motion)) - keep_out_m
        trace = self._squares @ motion.covariance.ravel() + self._noise_trace
        sigma_m = np.sqrt(np.maximum(np.maximum(trace[:-1], trace[1:]), 1e-18))
        bound = np.where(room_m > 0.0, room_m / sigma_m, -np.inf)
        first = np.array([np.argmin(bound)])
        least = self._closest_in(first, states, motion, keep_out_m).margin_sigmas.min()
        return np.flatnonzero(bound <= least + 1e-9 * abs(least))

    def _room(self, states: Array, drift: Array) -> Array:
        """Return lower bounds on the distance from the target, m, in each of the T - 1 steps of the
        coasts.

        ``states`` (M, 6). ``drift`` (T, 6): added to all coasts. Computed by native/coast.c.
        """
        columns, room = _columns(states), np.empty(len(self._times_s) - 1)
        work = scratch(columns.size)
        function("coast_room")(
            c_int64(len(room)),
            address(self._transitions),
            address(drift),
            c_int64(columns.shape[1]),
            address(columns),
            c_double(self._sagitta_share * self._step_s),
            address(room),
            address(work),
        )
        return room

    def _closest_in(
        self, columns: IntArray, states: Array, motion: DisturbedMotion, keep_out_m: float
    ) -> ClosestApproaches:
        """Return ``closest`` within these steps (L,) of the coasts (native/coast.c)."""
        padded, found = _columns(states), np.empty((3, -(-len(states) // 4) * 4))
        steps = np.ascontiguousarray(columns, dtype=np.int64)
        ends, place = np.unique(np.concatenate([steps, steps + 1]), return_inverse=True)
        spread = self._spread(ends, motion)[place.reshape(2, -1).T]
        approaches = (c_void_p * 3)(*map(location, found))
        function("coast_closest")(
            c_int64(len(steps)),
            address(steps),
            address(self._transitions),
            address(self._drift(motion)),
            c_int64(padded.shape[1]),
            address(padded),
            address(np.ascontiguousarray(spread)),
            c_double(keep_out_m),
            c_double(self._sagitta_share * self._step_s),
            approaches,
        )
        margins, away, moments = found[:, : len(states)]
        return ClosestApproaches(margins, away, moments * self._step_s)


def coast_covariance(
    mean_motion_rad_s: float, step_s: float, count: int, noise: CoastNoise
) -> Array:
    """Return the covariances (count, 3, 3) that process noise gives the position of a coast, at
    multiples of ``step_s``.

    Discretized exactly (C. Van Loan, IEEE Trans. Automatic Control 23(3), 1978).
    """
    change, density = np.zeros((9, 9)), np.zeros(9)
    change[:6, :6], change[3:6, 6:] = cw_matrix(mean_motion_rad_s), np.eye(3)
    change[6:, 6:] = -np.eye(3) / noise.varying_s
    density[3:6] = noise.white_m_s2_sqrt_s**2
    density[6:] = 2.0 * noise.varying_m_s2**2 / noise.varying_s
    whole = np.block([[-change, np.diag(density)], [np.zeros((9, 9)), change.T]])
    found = _exponential(step_s * whole)
    transition = found[9:, 9:].T
    added = transition @ found[:9, 9:]
    covariances, now = np.zeros((count, 3, 3)), np.zeros((9, 9))
    for k in range(1, count):
        now = transition @ now @ transition.T + added
        covariances[k] = now[:3, :3]
    return covariances


def _exponential(matrix: Array) -> Array:
    """Return the exponential of a square matrix: its series after scaling, then squaring."""
    squarings = max(0, math.ceil(math.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1.0))))
    scaled, term = matrix / 2.0**squarings, np.eye(len(matrix))
    total = term.copy()
    for k in range(1, 20):
        term = term @ scaled / k
        total += term
    for _ in range(squarings):
        total = total @ total
    return total


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
