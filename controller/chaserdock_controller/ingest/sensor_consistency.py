# SPDX-License-Identifier: Apache-2.0
"""Consistency of each chaser's sightings with the fused estimate. No I/O."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from chaserdock_protocol.messages import Level

DISAGREES_S = 0.6
"""A chaser whose sightings were all rejected for this long is inconsistent."""
AGREES_S = 0.6


@dataclass
class SensorConsistency:
    """Chasers whose sightings the estimator keeps rejecting, by a fault of camera or odometry.

    ``confirmed``: chasers whose sightings were accepted for ``AGREES_S`` since their odometry was
    last interrupted.
    """

    inconsistent: set[int] = field(default_factory=set)
    confirmed: set[int] = field(default_factory=set)
    _interrupted_s: dict[int, float] = field(default_factory=dict)
    _since_s: dict[int, tuple[bool, float]] = field(
        default_factory=lambda: defaultdict(lambda: (True, 0.0))
    )

    @property
    def doubtful(self) -> frozenset[int]:
        """Return the chasers whose odometry may be wrong: a jump between two of its states would
        have been noticed, but none before its first state, or while it was interrupted."""
        return frozenset(self.inconsistent - self.confirmed)

    def update(
        self,
        now_s: float,
        accepted: Iterable[int],
        rejected: Iterable[int],
        interrupted: Iterable[int] = (),
    ) -> list[tuple[Level, str]]:
        """Add a tick's accepted and rejected chasers, and those whose odometry was ``interrupted``
        before it; return the events.
        """
        events: list[tuple[Level, str]] = []
        self._interrupted_s.update(dict.fromkeys(interrupted, now_s))
        self.confirmed.difference_update(interrupted)
        for agrees, chasers in ((True, accepted), (False, rejected)):
            for i in chasers:
                before, since_s = self._since_s[i]
                if (
                    agrees
                    and before
                    and now_s - max(since_s, self._interrupted_s.get(i, 0.0)) >= AGREES_S
                ):
                    self.confirmed.add(i)
                if before != agrees:
                    self._since_s[i] = (agrees, now_s)
                elif not agrees and i not in self.inconsistent and now_s - since_s >= DISAGREES_S:
                    self.inconsistent.add(i)
                    text = f"chaser {i}: sightings disagree with the other chasers: camera or odometry fault"
                    events.append(("warning", text))
                elif agrees and i in self.inconsistent and now_s - since_s >= AGREES_S:
                    self.inconsistent.discard(i)
                    events.append(
                        ("info", f"chaser {i}: sightings agree with the other chasers again")
                    )
        return events
