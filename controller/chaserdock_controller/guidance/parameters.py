# SPDX-License-Identifier: Apache-2.0
"""Tuned numbers of the phases and moves of the chasers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GuidanceParameters:
    """Times in s, distances in m; speed factors multiply `approach.max_speed_m_s`."""

    goto_speed_factor: float = 2.0
    """Moves that end far from the target may be faster than an approach."""
    abort_speed_factor: float = 2.0
    """An abort leaves faster than a retreat, which backs out as slowly as an approach."""
    search_after_s: float = 1.0
    """Time without the target's pose after which a chaser searches. A few images may miss the
    target.
    """
    sight_loss_s: float = 3.0
    """An approach stops when no chaser has seen the target for this long."""
    held_margin_m: float = 0.03
    """Distance by which the plan of a chaser that docks at a distance may come closer than that, so
    that its keep-out does not push it off its reference.
    """
    outside_m: float = 0.02
    """A chaser this far outside its cone is planned without it (docs/controller.md)."""
    aligned_s: float = 1.0
    """Time for which a chaser must keep the corridor's limits before it flies in."""
    in_line_m: float = 0.3
    """Greatest distance from its port's axis from which a chaser flies straight to its corridor."""
    pull_sigmas: float = 5.0
    """Motion in the pull test, in sigmas of the estimate's change, that is held against the latch.
    A chi of three degrees of freedom exceeds it with 1.5e-5: of 60 changes, in position and
    attitude over 2 s of 15 Hz, one does so in at most one test of 1000. At higher rates changes of
    neighbouring ticks are nearly the same.
    """
    release_s: float = 1.0
    """A latch still closed this long after the command to release it counts as stuck."""
    identify_s: float = 10.0
    """Length of the manoeuvre that shows the mass properties of a stack: 16 pulses of 0.6 s."""
    stack_rest_s: float = 0.5
    """Time for which a stack must be below its limits to count as stopped."""
    stack_moving_s: float = 0.2
    """Time for which a stopped stack must move before it is stopped again; meanwhile it drifts."""
    stack_settling_s: float = 0.5
    """Time after the last thrust before a stopped stack is judged again. The mean motion, whose
    time constant this is, still contains the motion before.
    """


GUIDANCE = GuidanceParameters()
