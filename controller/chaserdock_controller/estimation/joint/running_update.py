# SPDX-License-Identifier: Apache-2.0
"""State of the joint filter while the measurements of a tick are processed, in both forms of its
covariance (see ``covariance``).
"""

from __future__ import annotations

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from msgspec.structs import replace
from numpy.typing import NDArray

from chaserdock_controller.bodies.body_shape import SHAPE

from . import kernels
from .kernels import CHASER_MEAN, TARGET_MEAN
from .star import ChasersGivenTarget, pair, split
from .state import ATTITUDE, CHASER, TARGET, JointState, mean_fields, packed


class RunningUpdate:
    """State while the chasers of a tick are processed one by one. Its arrays change; those of
    ``state`` do not.

    covariance (D, D): only the lower triangle is valid. rejections, nis, log_likelihood: as in
    ``JointState``.
    """

    def __init__(self, state: JointState) -> None:
        self.state, self.rejections, self.nis = state, state.rejections.copy(), state.nis.copy()
        self.log_likelihood, self.shape = state.log_likelihood, state.shape
        self._begin(packed(state), state.covariance)

    def _begin(self, mean: Array, covariance: Array) -> None:
        """Begin with the state's mean and covariance."""
        self.mean, self.covariance = mean, covariance.copy()
        chasers = kernels.check_size(self.mean, self.covariance)
        self.innovation = kernels.JointInnovation(chasers, len(self.covariance))

    def place(self, chaser: int) -> tuple[int, int]:
        """Return of how many chasers ``mean`` and ``covariance`` are, and which of these is
        ``chaser``. Call before its measurements are used.
        """
        return self.state.chasers, chaser

    def values(self, z: kernels.NativeMeasurement) -> list[float]:
        """Compute the innovation of a measurement. Returns for each channel the squared normalized
        residual, then the determinant of the sighting's innovation covariance.
        """
        self.innovation.innovate(z, self.mean, self.mean, self.covariance)
        return self.innovation.values.tolist()

    def correct(
        self, z: kernels.NativeMeasurement, used: NDArray[np.int64], iterations: int
    ) -> None:
        """Update by the rows ``used`` of the last innovation, relinearized up to ``iterations``
        times.

        Raises numpy.linalg.LinAlgError for an innovation covariance that is not positive definite.
        """
        innovation, prior = self.innovation, self.mean
        self.mean = np.empty_like(prior)
        for k in range(iterations):
            if k:
                innovation.innovate(z, self.mean, prior, self.covariance)
            if not innovation.correct(z, used, prior, self.mean):
                raise np.linalg.LinAlgError("the innovation covariance is not positive definite")
        innovation.reduce(z, len(used), self.covariance)
        if self.shape is not None:
            self.shape = self.shape.corrected(innovation.correction[-SHAPE:])

    def finished(self, updates: int, markers: NDArray[np.int64]) -> JointState:
        """Return the state after the updates, with these fields."""
        kernels.complete(self.covariance)
        return self._replaced(self.mean, self.covariance, updates, markers)

    def _replaced(
        self, mean: Array, covariance: Array, updates: int, markers: NDArray[np.int64]
    ) -> JointState:
        return replace(
            self.state,
            covariance=covariance,
            shape=self.shape,
            rejections=self.rejections,
            nis=self.nis,
            log_likelihood=self.log_likelihood,
            updates=updates,
            markers=markers,
            **mean_fields(mean),
        )


class StarUpdate(RunningUpdate):
    """The same with a covariance in star form: ``mean`` and ``covariance`` are those of a pair of
    target and chaser, and change with ``place``.

    What an update teaches of the target corrects the other chasers when it is their turn, or at the
    end. Their gains stay those by the target's error at the beginning of the tick, whose
    corrections add up in ``_learned`` (H,). ``_turn`` (3, 3) maps that error of the attitude to the
    present one, as corrections turn its axes; ``_back`` is the inverse.
    """

    def _begin(self, mean: Array, covariance: Array) -> None:
        given = self.state.given_target
        assert given is not None
        self._hub = covariance.copy()
        self._gains, self._rests = given.gains.copy(), given.covariances.copy()
        self._target, self._each = mean[:TARGET_MEAN], mean[TARGET_MEAN:].reshape(-1, CHASER_MEAN)
        size = len(self._hub)
        self._learned = np.zeros(size)
        self._turn: Array = np.eye(3)
        self._back: Array = np.eye(3)
        self._told = np.zeros((len(self._each), size))  # what of it each chaser's mean contains
        self._chaser: int | None = None
        self.innovation = kernels.JointInnovation(1, size + CHASER)

    def place(self, chaser: int) -> tuple[int, int]:
        if chaser != self._chaser:
            self._put_back()
            self._chaser = chaser
            self._tell(np.array([chaser]))
            self.mean = np.concatenate([self._target, self._each[chaser]])
            gain = _turned(self._gains[chaser], self._back)
            self.covariance = pair(self._hub, gain, self._rests[chaser])
        return 1, 0

    def correct(
        self, z: kernels.NativeMeasurement, used: NDArray[np.int64], iterations: int
    ) -> None:
        super().correct(z, used, iterations)
        error = self.innovation.correction
        self._learn(error)
        self._turn = so3.right_jacobian(error[ATTITUDE]) @ self._turn
        self._back = np.asarray(np.linalg.inv(self._turn), dtype=np.float64)

    def shift(self, error: Array, covariance: Array) -> None:
        """Correct the pair by its error, and replace its covariance."""
        self.mean, self.covariance = kernels.inject(self.mean, error[: TARGET + CHASER]), covariance
        if self.shape is not None:
            self.shape = self.shape.corrected(error[-SHAPE:])
        self._learn(error)

    def _learn(self, error: Array) -> None:
        """Add what the error of a pair says of the target to what was learned of it."""
        added = np.concatenate([error[:TARGET], error[TARGET + CHASER :]])
        added[ATTITUDE] = self._back @ added[ATTITUDE]
        self._learned += added

    def _tell(self, chasers: NDArray[np.int64]) -> None:
        """Correct the means of ``chasers`` by what their gains say of what was learned."""
        news = self._learned - self._told[chasers]
        if news.any():
            error = np.zeros(TARGET + CHASER * len(chasers))
            error[TARGET:] = (self._gains[chasers] @ news[:, :, None]).reshape(-1)
            before = np.concatenate([self._target, self._each[chasers].reshape(-1)])
            after = kernels.inject(before, error)[TARGET_MEAN:]
            self._each[chasers] = after.reshape(-1, CHASER_MEAN)
        self._told[chasers] = self._learned

    def _put_back(self) -> None:
        """Keep the pair that ``mean`` and ``covariance`` are of."""
        if (i := self._chaser) is None:
            return
        self._chaser = None
        kernels.complete(self.covariance)
        self._hub, gain, self._rests[i] = split(self.covariance)
        self._gains[i] = _turned(gain, self._turn)
        self._target, self._each[i] = self.mean[:TARGET_MEAN], self.mean[TARGET_MEAN:]
        self._told[i] = self._learned

    def finished(self, updates: int, markers: NDArray[np.int64]) -> JointState:
        self._put_back()
        self._tell(np.arange(len(self._each)))
        given = ChasersGivenTarget(_turned(self._gains, self._back), self._rests)
        mean = np.concatenate([self._target, self._each.reshape(-1)])
        return replace(self._replaced(mean, self._hub, updates, markers), given_target=given)


def _turned(gains: Array, turn: Array) -> Array:
    """Return gains (..., H) by the error of an attitude that ``turn`` (3, 3) maps to the present
    one.
    """
    out = gains.copy()
    out[..., ATTITUDE] = gains[..., ATTITUDE] @ turn
    return out


def running_update(state: JointState) -> RunningUpdate:
    """Return the update of a state in the form of its covariance."""
    return RunningUpdate(state) if state.given_target is None else StarUpdate(state)
