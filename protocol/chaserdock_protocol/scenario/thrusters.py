"""The scenario's sections of thrusters: where they sit, what they give, how they are pulsed, how they fail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from chaserdock_models.rotations import Array
from chaserdock_models.thruster_model import FailureKind
from chaserdock_models.wrench_set import wrench_matrix, wrench_set
from pydantic import AfterValidator, Field, model_validator

from .fields import NotNegative, Positive, Section, Vector

MAX_THRUSTERS = 24
"""Facets of the set of wrenches grow with the fifth power of the number of thrusters."""


def _unit(v: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*v)
    if abs(length - 1.0) > 1e-3:
        raise ValueError(f"must be of unit length; this one has length {length:.6g}")
    return (v[0] / length, v[1] / length, v[2] / length)


class Thruster(Section):
    """A thruster that is open or shut: where it sits (CRF), the direction of its force on the body (CRF, unit).

    Its thrust rises linearly within ``rise_s`` of the valve's opening and falls linearly within ``fall_s`` of its
    closing. A pulse shorter than ``min_on_s`` does not open the valve.
    """

    position_m: Vector
    direction: Annotated[Vector, AfterValidator(_unit)]
    thrust_N: Positive
    min_on_s: Positive = 0.010
    rise_s: NotNegative = 0.002
    fall_s: NotNegative = 0.002
    isp_s: Positive = 70.0

    @model_validator(mode="after")
    def _rises_in_time(self) -> Thruster:
        if self.min_on_s < self.rise_s:
            raise ValueError(f"min_on_s ({self.min_on_s}) must be at least rise_s ({self.rise_s})")
        return self


class Modulation(Section):
    """How thrusts become pulses: once a carrier period and thruster (docs/thrusters.md).

    ``resolution_s``: pulse widths are whole multiples of it. ``carry_over``: impulse that was asked for and not
    given, as under the minimum on-time, is asked for again in the next period. ``schmitt``: open for whole periods,
    from ``schmitt_on`` of the thruster's thrust on until less than ``schmitt_off`` of it is asked for.
    """

    modulator: Literal["pwm", "schmitt"] = "pwm"
    carrier_hz: Annotated[int, Field(ge=1, le=240)] = 10
    resolution_s: Positive = 0.001
    carry_over: bool = True
    schmitt_on: Annotated[float, Field(gt=0, le=1)] = 0.75
    schmitt_off: Annotated[float, Field(ge=0, lt=1)] = 0.25

    @model_validator(mode="after")
    def _possible(self) -> Modulation:
        if self.resolution_s < 1e-6:
            raise ValueError(f"resolution_s ({self.resolution_s}) must be at least a microsecond")
        if self.resolution_s > 0.5 / self.carrier_hz:
            raise ValueError(f"resolution_s ({self.resolution_s}) must be at most half a carrier period")
        if self.schmitt_off >= self.schmitt_on:
            raise ValueError("schmitt_off must be less than schmitt_on")
        return self


class ThrusterFailure(Section):
    """From ``at_s`` on a thruster of a chaser does not open, does not close, or gives ``factor`` of its thrust.

    ``reported``: the chaser is told at once; otherwise it has to find out.
    """

    chaser: Annotated[int, Field(ge=0)]
    thruster: Annotated[int, Field(ge=0)]
    at_s: NotNegative
    kind: FailureKind
    factor: Annotated[float, Field(ge=0, le=1)] | None = None
    reported: bool = False

    @model_validator(mode="after")
    def _factor(self) -> ThrusterFailure:
        if (self.kind == "weak") != (self.factor is not None):
            raise ValueError("factor goes with the kind weak, and weak needs it")
        return self


def thrusts_max(thrusters: Sequence[Thruster]) -> Array:
    """Full thrust (n,) of all thrusters, N."""
    return np.array([t.thrust_N for t in thrusters])


def check_layout(thrusters: Sequence[Thruster], force_max_N: float, torque_max_N_m: float) -> None:
    """Raises ValueError unless the thrusters can give every wrench within the limits, all axes at once."""
    if not thrusters:
        raise ValueError("actuation thrusters needs thrusters, or a body that has some: slider, tetra12")
    box = np.array([force_max_N] * 3 + [torque_max_N_m] * 3)
    scale = wrench_set(wrench_matrix(thrusters)).box_scale(thrusts_max(thrusters), box)
    if scale <= 1e-6:
        raise ValueError("thrusters cannot give force and torque in every direction: no 6-DoF control")
    if scale < 1.0:
        raise ValueError(
            f"force_max_N {force_max_N:g} and torque_max_N_m {torque_max_N_m:g} on all axes at once are more than "
            f"the thrusters can give; at most {scale:.3f} of both"
        )


def check_pulses(thrusters: Sequence[Thruster], modulation: Modulation, physics_hz: int) -> None:
    """Raises ValueError unless pulses fit into carrier periods, and these into whole physics steps."""
    carrier = modulation.carrier_hz
    if physics_hz % carrier:
        raise ValueError(
            f"time.physics_hz must be a multiple of chaser.modulation.carrier_hz ({physics_hz}, {carrier})"
        )
    longest = max(t.min_on_s + t.fall_s for t in thrusters)
    if longest > 1.0 / carrier:
        raise ValueError(
            f"chaser.modulation.carrier_hz: a period of {1.0 / carrier:g} s is shorter than the shortest pulse "
            f"with its fall, {longest:g} s"
        )
