# SPDX-License-Identifier: Apache-2.0
"""State that guidance keeps of one chaser, its inputs in a tick, and its answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import CameraCalibration, Level, Odometry
from msgspec import Struct

from chaserdock_controller.interfaces import PlanningFailure, RelativePose, TargetState

from .docking import DockingObservation
from .escape import RelativeState
from .phases import Phase, Trigger
from .pointing import SearchProgress, SurveyPlace
from .trajectories import Motion, Slew


class NextMove(StrEnum):
    """What follows when the current move is complete."""

    NONE = ""
    NOMINAL = "nominal"
    ATTEMPT = "attempt"
    ESCAPE = "escape"


@dataclass(frozen=True)
class ChaserGuidance:
    """Phase of a chaser and motion of its reference (TRF).

    ``since_s``: simulated time at which the phase began. ``inside_since_s``: time since which the
    chaser is within its tolerances. ``attempt``: number of the docking attempt, from 1. ``held``:
    its estimated pose in TRF when the pull test began. ``faces``: the reference attitude turns with
    the offset so that the chaser faces the target. ``turns``: the body flies the calibration
    manoeuvre. ``stuck``: it is to back out, but its latch does not open.
    ``search``: progress along the search pattern. ``survey``: where it stays while the target is
    mapped. ``slew``: turn from where it pointed after a
    pause to the reference attitude.
    """

    phase: Phase
    since_s: float
    move: Motion
    inside_since_s: float | None = None
    then: NextMove = NextMove.NONE
    attempt: int = 1
    held: RelativePose | None = None
    faces: bool = False
    turns: bool = False
    stuck: bool = False
    search: SearchProgress | None = None
    survey: SurveyPlace | None = None
    slew: Slew | None = None

    def over_at(self, now_s: float) -> bool:
        """Return whether its move and its turn are complete."""
        return self.move.over_at(now_s) and (self.slew is None or self.slew.over_at(now_s))

    def inside_since(self, inside: bool, now_s: float) -> float | None:
        """Return the time since which the chaser is within its tolerances, given whether it is
        ``inside`` now; None if it is not.
        """
        if not inside:
            return None
        return now_s if self.inside_since_s is None else self.inside_since_s


class Cause(NamedTuple):
    """Why a phase begins. ``place_m`` (3,), TRF: end of a commanded move, or place where a search
    ended.
    """

    trigger: Trigger
    now_s: float
    place_m: Array | None = None


class ChaserTick(Struct, frozen=True):
    """What is known of one chaser in a tick.

    ``own``: its estimated state, None without odometry. ``invalid``: its odometry is not valid.
    ``target``: the target's estimate. ``offset_m`` (3,): its centre in TRF; ``port``: its state at
    its port; both while the poses of target and chaser are known. ``latched``: its latch holds the
    target. ``doubtful``: its odometry may be wrong. ``acquiring``: it looks for the target in an
    earlier image; None without a sighting. ``stuck_thrusters``: found in the motion of the stack.
    ``relative``: its state relative to the target where passive safety is enforced. ``unsafe``: why
    its plans are not passively safe, or empty.
    """

    now_s: float
    own: Odometry | None
    target: TargetState
    offset_m: Array | None = None
    port: DockingObservation | None = None
    relative: RelativeState | None = None
    failure: PlanningFailure | None = None
    camera: CameraCalibration | None = None
    acquiring: bool | None = None
    stuck_thrusters: tuple[int, ...] = ()
    invalid: bool = False
    latched: bool = False
    doubtful: bool = False
    unsafe: str = ""


class TrackingErrors(NamedTuple):
    """Estimated errors of a chaser from its reference pose."""

    position_m: float
    angle_rad: float


@dataclass(frozen=True)
class CommandResult:
    """Whether a command is accepted, and the reason."""

    accepted: bool
    reason: str


@dataclass(frozen=True)
class PhaseChange:
    """A chaser entered ``phase``, or something happened in it. ``detail``: the previous phase and
    the reason, or the event.
    """

    chaser: int
    phase: Phase
    detail: str
    level: Level = "info"
