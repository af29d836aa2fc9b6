# SPDX-License-Identifier: Apache-2.0
"""Use images that a free-running camera exposes between two ticks at their own time: the tick is
split at their exposures, and the filter processes the parts one after the other.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import groupby

import numpy as np

from chaserdock_controller.estimation.types import MeasuredChaser
from chaserdock_controller.interfaces import AppliedImpulse

from .replay import FilterTick


def split_tick(since_ns: int, record: FilterTick) -> list[FilterTick]:
    """Return the parts of a tick that begins at ``since_ns``: one up to each exposure between, then
    one up to the tick with its odometry.

    Impulses are spread evenly over the time that they cover. Their first moment goes to the longest
    part, which leaves the motion up to the tick as it was. Magnitudes, which scale process noise,
    go by the root of the time: the variances of the parts add up to that of the whole tick.
    """
    exposures = [
        (time_ns, {s.chaser: s for s in group})
        for time_ns, group in groupby(record.between, key=lambda s: s.sim_time_ns)
        if time_ns > since_ns
    ]
    ends_ns = [*(time_ns for time_ns, _ in exposures), record.time_ns]
    begins_ns = [since_ns, *ends_ns[:-1]]
    covered_from_ns = record.time_ns - round(record.covered_s * 1e9)
    covered_s = [
        max(0, end - max(begin, covered_from_ns)) / 1e9
        for begin, end in zip(begins_ns, ends_ns, strict=True)
    ]
    longest = int(np.argmax(covered_s))
    parts = []
    for k, end_ns in enumerate(ends_ns):
        share, is_last = covered_s[k] / record.covered_s, k == len(ends_ns) - 1
        part = dataclasses.replace(
            record,
            time_ns=end_ns,
            covered_s=covered_s[k],
            chasers=tuple(
                _part_of(c, share, holds_moment=k == longest, is_last=is_last)
                for c in record.chasers
            ),
            sightings=record.sightings if is_last else exposures[k][1],
            between=[],
        )
        parts.append(part)
    return parts


def _part_of(
    chaser: MeasuredChaser, share: float, *, holds_moment: bool, is_last: bool
) -> MeasuredChaser:
    """Return what is known of a chaser in a part of a tick; what is measured at the tick is in the
    last one.
    """
    given = chaser.impulse
    impulse = AppliedImpulse(
        given.impulse * share,
        given.moment if holds_moment else np.zeros(6),
        given.magnitude * math.sqrt(share),
        given.measured,
    )
    if is_last:
        return dataclasses.replace(chaser, impulse=impulse)
    return MeasuredChaser(chaser.chaser, impulse, latched=chaser.latched)
