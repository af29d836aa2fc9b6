# SPDX-License-Identifier: Apache-2.0
"""Detect thruster faults from the difference of commanded and observed impulse (docs/thrusters.md).

Single faults only; no I/O. Two hypotheses are tested for every thruster, each with its signature:
stuck on (constant full thrust: the residual is the part that was not commanded) and weak or stuck
off (the residual is the negative of a share of what was commanded). A hypothesis is accepted if the
residuals are much more likely under it than without a fault (likelihood ratio), are consistent with
it (chi-square), and neither another thruster nor a loss of whole commands, which no thruster gave,
explains them nearly as well. A weak thruster stays a suspect: what it is known to give counts as
commanded.

Mass properties and thrusts that differ from the model cause residuals too, the same ones at every
tick. All likelihoods are those after integration over these constant differences with their prior,
so that only what they cannot explain counts.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.thrusters import FailureKind
from numpy.typing import NDArray

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class DetectionParameters:
    """Thresholds of the tests (docs/thrusters.md)."""

    # Minimum log-likelihood ratio to the fault-free hypothesis: 1 in 5e8, at some thousand tests
    # per minute and thruster.
    min_gain: float = 20.0
    # Minimum log-likelihood ratio to the second-best thruster: 1 in 3,000.
    min_margin: float = 8.0
    # Numbers of consecutive ticks that are tested for a thruster stuck on. At least two, as a
    # single one may be a disturbance.
    on_windows: tuple[int, ...] = (2, 3, 4, 6, 8)
    # Numbers of latest ticks with commanded thrust that are tested together. Each is about half as
    # large again as the one before, as the information adds up.
    off_windows: tuple[int, ...] = (2, 3, 4, 6, 9, 15, 30)
    # Relative loss of thrust from which a thruster counts as stuck off: two ``loss_sigma`` below
    # all of it.
    stuck_off_loss: float = 0.85
    # Relative loss from which it counts as weak: four ``loss_sigma``, so that scatter and mismatch
    # are not taken for a loss.
    weak_loss: float = 0.3
    # Relative uncertainty of the failed thruster's thrust.
    own_scatter: float = 0.1
    # Maximum standard deviation of the loss with which a thruster counts as weak: a share of the
    # thrust goes on being used. Stuck off needs the gain only: equal test burns of `slider`
    # never tell a loss to less than 0.12: mass, inertia and the other thrusts are uncertain.
    loss_sigma: float = 0.07
    # Sigmas within which the latest tick agrees with the loss of a weak thruster. A window that
    # begins before a complete loss shows a part of it on average.
    latest_sigmas: float = 3.0


_TEST = DetectionParameters()
MAX_TICKS = max(_TEST.off_windows)
"""Latest ticks with pulses of a thruster that are kept."""

_MIN_ENERGY = 1.9 * _TEST.min_gain
"""Energy r'r of whitened residuals below which no hypothesis is accepted. None gains more than half
of it (Cauchy-Schwarz), and the mismatch only reduces it; 5 % are left for rounding.
"""
SUFFICIENT_INFORMATION = 2.0 / _TEST.loss_sigma**2
"""Inverse variance of a thruster's loss, for a plant as modelled, at which it is known to
``loss_sigma``. The factor 2: half of it is lost to the uncertainty of the nominal thrust (5 %).
"""


@dataclass(frozen=True)
class ThrusterFault:
    """A detected fault; ``factor``: remaining share of the full thrust (1 for stuck on)."""

    thruster: int
    kind: FailureKind
    factor: float


class _Evidence:
    """Sums over ticks of the whitened quantities of all hypotheses, as one vector each.

    Residual r (6,), signatures f (6, n) of the hypotheses of all thrusters, and signatures m (6, q)
    of the mismatch per standard deviation.
    """

    def __init__(self, thrusters: int, differences: int) -> None:
        n, q = thrusters, differences
        self._n, self._shape = n, (q, 1 + n + q)

    def of_tick(self, residual: Array, signatures: Array, mismatch: Array) -> Array:
        """Return the vector of one tick: r'r, f'r (n,), f'f (n,) and m' [r f m] (q, 1 + n + q)."""
        columns = np.column_stack([residual, signatures, mismatch])
        return np.concatenate(
            [
                [residual @ residual],
                signatures.T @ residual,
                (signatures**2).sum(axis=0),
                (mismatch.T @ columns).ravel(),
            ]
        )

    def marginal(self, total: Array) -> tuple[float, Array, Array]:
        """Return energy r'r, f'r (n,) and f'f (n,) after integration over the mismatch.

        It gives the residuals the inverse covariance I - m (I + m'm)^-1 m'. Zeros where rounding
        has left nothing of it, as with speeds that no chaser has.
        """
        n = self._n
        parts = total[1 + 2 * n :].reshape(self._shape)
        information = parts[:, 1 + n :] + np.eye(len(parts))
        try:
            factor = np.linalg.cholesky(information)
        except np.linalg.LinAlgError:
            return 0.0, np.zeros(n), np.zeros(n)
        white = np.linalg.solve(factor, parts[:, : 1 + n])
        energy = float(total[0] - white[:, 0] @ white[:, 0])
        along = total[1 : 1 + n] - white[:, 1:].T @ white[:, 0]
        squared = total[1 + n : 1 + 2 * n] - (white[:, 1:] ** 2).sum(axis=0)
        return energy, along, np.maximum(squared, 0.0)


class ThrusterFaultDetector:
    """Test the residuals of the last ticks for a fault.

    ``matrix`` (6, n): see ``wrench_matrix``. ``min_on_s`` (n,): shortest pulses. ``differences``:
    number of constant differences between plant and model. ``fired`` (n,): suspects with a pulse
    in the last update.
    """

    def __init__(self, matrix: Array, min_on_s: Array, differences: int) -> None:
        self._matrix, self._min_on_s = matrix, min_on_s
        self._on_evidence = _Evidence(len(min_on_s), differences)
        # One more hypothesis after those of the thrusters: whole commands are lost.
        self._off_evidence = _Evidence(len(min_on_s) + 1, differences)
        self._on: deque[Array] = deque(maxlen=max(_TEST.on_windows))
        self._off: list[deque[Array]] = []
        self.fired: Flags = np.zeros(len(min_on_s), dtype=np.bool_)
        self.reset()

    def reset(self) -> None:
        """Discard the residuals, as a change explains them."""
        self._on.clear()
        self._off = [deque(maxlen=MAX_TICKS) for _ in self._min_on_s]

    def update(
        self,
        residual: Array,
        noise: Array,
        commanded_N_s: Array,
        time_s: float,
        suspects: Flags,
        mismatch: Array,
        known_N: Array,
    ) -> ThrusterFault | None:
        """Add the residual of one tick; return a fault if one is detected.

        ``residual`` (6,): observed minus expected impulse; ``noise`` (6, 6): its covariance;
        ``commanded_N_s`` (n,): expected impulse of every thruster in ``time_s``; ``suspects`` (n,):
        thrusters that may have failed; ``mismatch`` (6, differences): see ``mismatch_signatures``;
        ``known_N`` (n,): thrust of each when open. The fault's factor is a share of that.
        """
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        white, columns = whiten @ residual, whiten @ self._matrix
        constant = whiten @ mismatch
        extra = known_N * time_s - commanded_N_s
        self._on.append(self._on_evidence.of_tick(white, columns * extra, constant))
        fired = suspects & (commanded_N_s > 0.5 * known_N * self._min_on_s)
        self.fired = fired
        signatures = -columns * commanded_N_s
        signatures = np.column_stack([signatures, signatures.sum(axis=1)])
        lost = self._off_evidence.of_tick(white, signatures, constant)
        for thruster in np.flatnonzero(fired):
            self._off[thruster].append(lost)
        return self._detect_stuck_on(suspects) or self._detect_loss(
            np.flatnonzero(fired).tolist(), suspects
        )

    def ticks_to_tell(self, thruster: int) -> int | None:
        """Return how many of the latest ticks with pulses of a thruster tell whether it is stuck
        off, as that would gain enough; None if all of them do not.
        """
        for length, total in _totals(self._off[thruster], _TEST.off_windows):
            if self._off_evidence.marginal(total)[2][thruster] / 2.0 > _TEST.min_gain:
                return length
        return None

    def _detect_stuck_on(self, suspects: Flags) -> ThrusterFault | None:
        for length, total in _energetic(self._on, _TEST.on_windows):
            energy, along, squared = self._on_evidence.marginal(total)
            gain = np.where(suspects, along - squared / 2.0, -math.inf)
            best = int(np.argmax(gain))
            if _is_distinct(gain, best) and is_consistent(
                energy, float(2.0 * gain[best]), float(squared[best]), length
            ):
                return ThrusterFault(best, "stuck_on", 1.0)
        return None

    def _detect_loss(self, fired: list[int], suspects: Flags) -> ThrusterFault | None:
        possible = np.append(suspects, True)
        for thruster in fired:
            for length, total in _energetic(self._off[thruster], _TEST.off_windows):
                energy, along, squared = self._off_evidence.marginal(total)
                loss = np.where(
                    squared > 0.0,
                    np.clip(along / np.where(squared > 0.0, squared, 1.0), 0.0, 1.0),
                    0.0,
                )
                gain = np.where(possible, loss * along - loss**2 * squared / 2.0, -math.inf)
                stuck_off = loss[thruster] > _TEST.stuck_off_loss
                if (
                    not (stuck_off or self._is_weak(thruster, loss[thruster], squared[thruster]))
                    or loss[thruster] < _TEST.weak_loss
                    or int(np.argmax(gain)) != thruster
                ):
                    continue
                if _is_distinct(gain, thruster) and is_consistent(
                    energy, float(2.0 * gain[thruster]), float(squared[thruster]), length
                ):
                    return ThrusterFault(
                        thruster,
                        "stuck_off" if stuck_off else "weak",
                        0.0 if stuck_off else float(1.0 - loss[thruster]),
                    )
        return None

    def _is_weak(self, thruster: int, loss: float, squared: float) -> bool:
        """Return whether a loss is known well enough, and the latest tick agrees with it."""
        _, along, latest = self._off_evidence.marginal(self._off[thruster][-1])
        off = along[thruster] - loss * latest[thruster]
        agrees = off**2 < _TEST.latest_sigmas**2 * latest[thruster]
        return bool(squared * _TEST.loss_sigma**2 >= 1.0 and agrees)


def _energetic(ticks: deque[Array], windows: tuple[int, ...]) -> Iterator[tuple[int, Array]]:
    """Yield the sums over the last ticks of each full window with enough energy for a fault."""
    if sum([float(tick[0]) for tick in ticks]) < _MIN_ENERGY:
        return
    for length, total in _totals(ticks, windows):
        if total[0] >= _MIN_ENERGY:
            yield length, total


def _totals(ticks: deque[Array], windows: tuple[int, ...]) -> Iterator[tuple[int, Array]]:
    """Yield the sums over the last ticks of each full window."""
    total, first = 0.0, len(ticks)
    for length in windows:
        if len(ticks) < length:
            return
        total = total + np.sum([ticks[k] for k in range(len(ticks) - length, first)], axis=0)
        first = len(ticks) - length
        yield length, total


def _is_distinct(gain: Array, best: int) -> bool:
    others = np.delete(gain, best)
    return bool(
        gain[best] > _TEST.min_gain
        and gain[best] - others.max(initial=-math.inf) > _TEST.min_margin
    )


def is_consistent(energy: float, explained: float, squared: float, ticks: int) -> bool:
    """Return whether the residuals are noise under a hypothesis.

    ``energy`` less the share that it ``explained`` is tested by chi-square with 6 degrees of
    freedom per tick, five sigma.
    """
    freedoms = 6.0 * ticks
    return (
        energy - explained
        < freedoms + 5.0 * math.sqrt(2.0 * freedoms) + _TEST.own_scatter**2 * squared
    )
