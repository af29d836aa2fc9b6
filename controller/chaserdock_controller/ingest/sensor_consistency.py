# SPDX-License-Identifier: Apache-2.0
"""Consistency of a chaser's sightings with the fused estimate. No I/O."""

from __future__ import annotations

from dataclasses import dataclass

from chaserdock_protocol.messages import Level

DISAGREES_S = 0.6
"""A chaser whose sightings were all rejected for this long is inconsistent."""
AGREES_S = 0.6
"""Time, s, for which its sightings must be accepted before they are trusted: as long as
``DISAGREES_S``.
"""


@dataclass
class SensorConsistency:
    """Tracks whether the estimator keeps rejecting the sightings of one chaser (``inconsistent``),
    because of a fault of camera or odometry.

    ``confirmed``: sightings were accepted for ``AGREES_S`` since its odometry was last interrupted,
    at ``interrupted_s``. ``agrees``: the last one was accepted; ``since_s``: time since which that
    has not changed.
    """

    chaser: int
    inconsistent: bool = False
    confirmed: bool = False
    interrupted_s: float = 0.0
    agrees: bool = True
    since_s: float = 0.0

    @property
    def doubtful(self) -> bool:
        """Return whether the odometry may be wrong. A jump would be noticed between two states, but
        not before the first one or during an interruption.
        """
        return self.inconsistent and not self.confirmed

    def interrupt(self, now_s: float) -> None:
        """Record that the odometry was interrupted before this tick."""
        self.interrupted_s, self.confirmed = now_s, False

    def update(self, now_s: float, agrees: bool) -> tuple[Level, str] | None:
        """Record whether the sightings of a tick were accepted. Returns an event, or None."""
        lasts_s = now_s - self.since_s
        if agrees and self.agrees:
            trusted_s = now_s - max(self.since_s, self.interrupted_s)
            self.confirmed = self.confirmed or trusted_s >= AGREES_S
        if self.agrees != agrees:
            self.agrees, self.since_s = agrees, now_s
        elif not agrees and not self.inconsistent and lasts_s >= DISAGREES_S:
            self.inconsistent = True
            what = "sightings disagree with the estimate: camera or odometry fault"
            return "warning", f"chaser {self.chaser}: {what}"
        elif agrees and self.inconsistent and lasts_s >= AGREES_S:
            self.inconsistent = False
            return "info", f"chaser {self.chaser}: sightings agree with the estimate again"
        return None
