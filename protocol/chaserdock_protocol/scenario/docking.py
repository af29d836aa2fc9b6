"""The scenario's section of docking: what counts as docked, the ports, the corridors and their limits."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from .fields import NotNegative, Positive, Section, Vector


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*value)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(f"must be a unit vector; this one has length {length:.6g}")
    x, y, z = (v / length for v in value)
    return (x, y, z)


class Port(Section):
    """Where one chaser docks: its probe's tip comes to ``position_m`` (TRF) against ``axis`` (TRF, unit, outwards)."""

    chaser: Annotated[int, Field(ge=0)]
    position_m: Vector
    axis: Annotated[Vector, AfterValidator(_direction)]


class PoseLimits(Section):
    """Most that a probe may be off its port's axis: sideways, in attitude, and sideways in speed."""

    lateral_m: Positive
    angle_deg: Positive
    lateral_speed_m_s: Positive


class Tolerances(PoseLimits):
    """Within which the latch closes when the tip touches; ``closing_m_s`` is the speed at the touch."""

    lateral_m: Positive = 0.01
    angle_deg: Positive = 3.0
    lateral_speed_m_s: Positive = 0.01
    closing_m_s: Positive = 0.02


class Final(PoseLimits):
    """Limits over the last ``Docking.final_m``; of the closing speed once the slowing down is over."""

    lateral_m: Positive = 0.008
    angle_deg: Positive = 2.0
    lateral_speed_m_s: Positive = 0.008
    closing_m_s: Positive = 0.016


class Corridor(PoseLimits):
    """Limits of align (at its end) and of the approach, before ``final``."""

    lateral_m: Positive = 0.03
    angle_deg: Positive = 4.0
    lateral_speed_m_s: Positive = 0.02
    closing_m_s: Positive = 0.04


class Docking(Section):
    """How docking ends: ``held`` at a distance (``approach``'s tolerances, as in the paper), or by ``capture``.

    Distances are between the probe's tip and the port along the port's axis: a corridor begins ``entry_m`` out, its
    last ``final_m`` are flown at ``contact_speed_m_s``, what is before at ``approach_speed_m_s``. The reference goes
    on to ``overdrive_m`` behind the port. ``pull_N`` for ``pull_s``, and as long a push back, must not move a latched
    chaser by more than ``verify_*``. A chaser whose way in comes within ``clearance_m`` of another's, centre to
    centre, waits, as does one more than ``at_once``. A chaser on its way in or out, by capture or not, is planned inside
    a cone about its axis, of half angle ``corridor_angle_deg``, in place of the distance that the others keep.
    """

    kind: Literal["held", "capture"] = "held"
    ports: tuple[Port, ...] = ()
    entry_m: Positive = 0.35
    final_m: Positive = 0.10
    overdrive_m: Positive = 0.03
    approach_speed_m_s: Positive = 0.025
    contact_speed_m_s: Positive = 0.01
    corridor: Corridor = Corridor()
    corridor_angle_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 20.0
    final: Final = Final()
    tolerances: Tolerances = Tolerances()
    clearance_m: NotNegative = 0.45
    at_once: Annotated[int, Field(ge=1)] = 2
    attempts: Annotated[int, Field(ge=1, le=100)] = 3
    align_timeout_s: Positive = 60.0
    approach_timeout_s: Positive = 60.0
    final_timeout_s: Positive = 30.0
    contact_timeout_s: Positive = 5.0
    settle_s: Positive = 2.0
    pull_N: Positive = 0.5
    pull_s: Positive = 1.0
    verify_position_m: Positive = 0.005
    verify_angle_deg: Positive = 0.5

    @model_validator(mode="after")
    def _consistent(self) -> Docking:
        if self.kind == "capture" and not self.ports:
            raise ValueError("kind capture needs at least one of [[docking.ports]]")
        chasers = [port.chaser for port in self.ports]
        for chaser in chasers:
            if chasers.count(chaser) > 1:
                raise ValueError(f"ports: chaser {chaser} has more than one")
        if self.final_m >= self.entry_m:
            raise ValueError(f"final_m ({self.final_m:g}) must be less than entry_m ({self.entry_m:g})")
        if self.contact_speed_m_s > self.approach_speed_m_s:
            raise ValueError(
                f"contact_speed_m_s ({self.contact_speed_m_s:g}) must not exceed approach_speed_m_s "
                f"({self.approach_speed_m_s:g})"
            )
        return self

    def port_of(self, chaser: int) -> Port | None:
        """The port where a chaser is to be captured, or None."""
        if self.kind != "capture":
            return None
        return next((port for port in self.ports if port.chaser == chaser), None)
