# SPDX-License-Identifier: Apache-2.0
"""Guidance state of one chaser, and the result of a command."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Level

from .phases import Phase
from .trajectories import Motion


class NextMove(StrEnum):
    """What follows when the current move is complete."""

    NONE = ""
    NOMINAL = "nominal"
    ATTEMPT = "attempt"
    ESCAPE = "escape"


@dataclass(frozen=True)
class ChaserGuidance:
    """Phase since ``since_s`` (simulated time) and motion of the reference in TRF.

    ``inside_since_s``: since when the chaser is within its tolerances. ``attempt``: number of the
    docking attempt, from 1. ``held``: position (3,) and attitude (4,) in TRF when the pull test
    began. ``faces``: the reference attitude turns with the offset so that the chaser faces the
    target. ``stuck``: it is to back out, but its latch does not open.
    """

    phase: Phase
    since_s: float
    move: Motion
    inside_since_s: float | None = None
    then: NextMove = NextMove.NONE
    attempt: int = 1
    held: tuple[Array, Array] | None = None
    faces: bool = False
    stuck: bool = False


@dataclass(frozen=True)
class CommandResult:
    """Whether a command is accepted, and why or why not."""

    accepted: bool
    reason: str


@dataclass(frozen=True)
class PhaseChange:
    """A chaser entered ``phase``; ``detail`` names the phase before and the reason, or what has
    happened in the phase.
    """

    chaser: int
    phase: Phase
    detail: str
    level: Level = "info"
    calibration_complete: bool = False
