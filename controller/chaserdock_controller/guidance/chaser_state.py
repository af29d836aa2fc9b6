"""What guidance knows of one chaser, and what it answers to a command."""

from __future__ import annotations

from dataclasses import dataclass

from chaserdock_models.rotations import Array

from .trajectories import Motion


@dataclass(frozen=True)
class ChaserGuidance:
    """One chaser: its phase since ``since_s``, the motion of its reference in TRF, how long it has been in place.

    By capture: ``then``, what follows when the move is over (``nominal``, ``align`` or nothing, which is to hold);
    ``attempt``, from 1; ``held``, its pose in TRF when the pull began. ``faces``: it is on its way from where it found the
    target, and its reference attitude turns with the offset.
    """

    phase: str
    since_s: float
    move: Motion
    inside_since_s: float | None = None
    then: str = ""
    attempt: int = 1
    held: tuple[Array, Array] | None = None
    faces: bool = False


@dataclass(frozen=True)
class Answer:
    """To a command: accepted or not, and why."""

    accepted: bool
    reason: str
