"""Whether what each chaser sees agrees with what all see together: who does not is named. No I/O."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from chaserdock_protocol.messages.fields import Level

DISAGREES_S = 0.6
"""A chaser whose sightings have all been refused for so long disagrees."""
AGREES_S = 0.6


@dataclass
class SensorConsistency:
    """Which chasers' sightings the estimator has refused for how long. A lying camera or odometry shows in this."""

    disagreeing: set[int] = field(default_factory=set)
    _since_s: dict[int, tuple[bool, float]] = field(default_factory=lambda: defaultdict(lambda: (True, 0.0)))

    def observe(
        self, now_s: float, accepted: Iterable[int], rejected: Iterable[int]
    ) -> list[tuple[Level, str]]:
        """Takes a tick's verdicts; what changed: level and text, for the log."""
        told: list[tuple[Level, str]] = []
        for agrees, chasers in ((True, accepted), (False, rejected)):
            for i in chasers:
                before, since_s = self._since_s[i]
                if before != agrees:
                    self._since_s[i] = (agrees, now_s)
                    continue
                if not agrees and i not in self.disagreeing and now_s - since_s >= DISAGREES_S:
                    self.disagreeing.add(i)
                    told.append(
                        (
                            "warning",
                            f"chaser {i}: what it sees disagrees with the others: its camera or odometry lies",
                        )
                    )
                elif agrees and i in self.disagreeing and now_s - since_s >= AGREES_S:
                    self.disagreeing.discard(i)
                    told.append(("info", f"chaser {i}: what it sees agrees with the others again"))
        return told
