"""Which thruster has failed: its own part in the mismatch of commanded and observed impulse (docs/thrusters.md).

Every thruster is held against two hypotheses, each with its signature: stuck on (full thrust at all times: the residual is
what it was not asked for) and weak or stuck off (the residual is the negative of a part of what it was asked for). A
hypothesis is accepted when the residuals are much likelier under it than under health (likelihood ratio), explain
themselves with it (chi-square), and no other thruster explains them nearly as well. No I/O; one failure is looked for at a time.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.thrusters import FailureKind
from numpy.typing import NDArray

Flags = NDArray[np.bool_]

_LIKELIER = 20.0
"""Least log-likelihood gained over health: one in 5e8, for some thousand looks a minute and thruster."""
_CLEARER = 8.0
"""Least log-likelihood gained over the second-best thruster."""
_ON_WINDOWS = (2, 3, 4, 6, 8)
"""Ticks in a row that a thruster may have been stuck on; one alone might be a bump."""
_OFF_WINDOWS = (2, 3, 4, 6, 9, 15, 30)
"""Ticks in which a thruster was asked for something, the newest of them, that are looked at together."""
_GONE = 0.85
_NOTICEABLE = 0.3
"""Parts of its thrust that a thruster has lost when it counts as stuck off, and as weak."""
_OWN_SCATTER = 0.1
"""How well the failed thruster's own thrust is known."""
_LOSS_SIGMA = 0.07
"""How well the lost part must be known."""
ENOUGH = 1.0 / _LOSS_SIGMA**2
"""Information about a thruster (``ThrusterFaultDetector.information``) from which on its lost part is known that well."""


@dataclass(frozen=True)
class Verdict:
    """A thruster has failed; ``factor`` is what is left of its thrust (1 for stuck on)."""

    thruster: int
    kind: FailureKind
    factor: float


class ThrusterFaultDetector:
    """The evidence of the last ticks against the thrusters of one chaser; ``matrix`` (6, n) as of ``wrench_matrix``.

    ``information`` (n,): how much the last look told of what every thruster has lost of its thrust, one over variance.
    """

    def __init__(self, matrix: Array, full_N: Array, least_N_s: Array) -> None:
        self._matrix, self._full_N, self._least_N_s = matrix, full_N, least_N_s
        self._on: deque[tuple[Array, Array, float]] = deque(maxlen=max(_ON_WINDOWS))
        self._off: list[deque[tuple[Array, Array, float]]] = []
        self.information = np.zeros(len(full_N))
        self.forget()

    def forget(self) -> None:
        """Starts anew: something has changed that explains what was seen so far."""
        self._on.clear()
        self._off = [deque(maxlen=max(_OFF_WINDOWS)) for _ in self._full_N]

    def look(
        self, residual: Array, noise: Array, asked_N_s: Array, time_s: float, suspects: Flags
    ) -> Verdict | None:
        """One tick's evidence: observed less expected impulse (6,) with its covariance (6, 6), what every thruster was to
        give (n,) in ``time_s``; ``suspects`` (n,) are the thrusters that may have failed. A verdict, if there is one."""
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        seen = whiten @ residual
        columns = whiten @ self._matrix
        extra = self._full_N * time_s - asked_N_s
        # Per thruster: signature times residual, signature squared; and the residual squared.
        along, squared = columns.T @ seen, (columns**2).sum(axis=0)
        energy = float(seen @ seen)
        self._on.append((extra * along, extra**2 * squared, energy))
        fired = suspects & (asked_N_s > 0.5 * self._least_N_s)
        self.information = np.where(fired, asked_N_s**2 * squared, 0.0)
        for thruster in np.flatnonzero(fired):
            self._off[thruster].append((-asked_N_s * along, asked_N_s**2 * squared, energy))
        return self._stuck_on(suspects) or self._lost(np.flatnonzero(fired).tolist(), suspects)

    def _stuck_on(self, suspects: Flags) -> Verdict | None:
        for length in _ON_WINDOWS:
            if len(self._on) < length:
                break
            along, squared, energy = (np.sum(x, axis=0) for x in zip(*list(self._on)[-length:], strict=True))
            gain = np.where(suspects, along - squared / 2.0, -math.inf)
            best = int(np.argmax(gain))
            if _stands_out(gain, best) and _explained(
                energy, float(2.0 * gain[best]), float(squared[best]), length
            ):
                return Verdict(best, "stuck_on", 1.0)
        return None

    def _lost(self, fired: list[int], suspects: Flags) -> Verdict | None:
        for thruster in fired:
            evidence = self._off[thruster]
            for length in _OFF_WINDOWS:
                if len(evidence) < length:
                    break
                rows = list(evidence)[-length:]
                along, squared, energy = (np.sum(x, axis=0) for x in zip(*rows, strict=True))
                loss = np.where(
                    squared > 0.0, np.clip(along / np.where(squared > 0.0, squared, 1.0), 0.0, 1.0), 0.0
                )
                gain = np.where(suspects, loss * along - loss**2 * squared / 2.0, -math.inf)
                known = squared[thruster] >= ENOUGH
                if not known or loss[thruster] < _NOTICEABLE or int(np.argmax(gain)) != thruster:
                    continue
                if _stands_out(gain, thruster) and _explained(
                    energy, float(2.0 * gain[thruster]), float(squared[thruster]), length
                ):
                    gone = loss[thruster] > _GONE
                    return Verdict(
                        thruster,
                        "stuck_off" if gone else "weak",
                        0.0 if gone else float(1.0 - loss[thruster]),
                    )
        return None


def _stands_out(gain: Array, best: int) -> bool:
    others = np.delete(gain, best)
    return bool(gain[best] > _LIKELIER and gain[best] - others.max(initial=-math.inf) > _CLEARER)


def _explained(energy: float, taken: float, squared: float, ticks: int) -> bool:
    """Whether what a hypothesis leaves of the residuals' ``energy`` is noise: chi-square of 6 a tick, five sigma."""
    freedoms = 6.0 * ticks
    return energy - taken < freedoms + 5.0 * math.sqrt(2.0 * freedoms) + _OWN_SCATTER**2 * squared
