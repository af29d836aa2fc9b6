# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[truth]``: errors of the nominal values that the flight software assumes. Only
the world reads it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from .fields import Index, Number, Positive, Section, Vector
from .navigation import Degrees, Duration, FocalShare, Metres, OffsetPixels
from .oscillators import Oscillator

MismatchShare = Annotated[float, Field(ge=0, le=0.3, allow_inf_nan=False)]
Offset = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Force = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Torque = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Numbers6 = tuple[Number, Number, Number, Number, Number, Number]

MISMATCH: dict[str, dict[str, float]] = {
    "chaser": {
        "mass_share": 0.1,
        "inertia_share": 0.15,
        "centre_of_mass_m": 0.005,
        "thrust_share": 0.05,
        "thrust_turn_deg": 1.0,
        "force_N": 0.005,
        "torque_N_m": 0.0005,
    },
    "target": {"inertia_share": 0.15},
}
"""Figures of the preset ``mismatch``; all others are 0."""


class ChaserTruth(Section):
    """Differences of each chaser's body and actuators. Figures are standard deviations per axis,
    drawn from the seed once per chaser and limited to three of them, unless stated otherwise. A
    figure that is not given is that of the preset.
    """

    mass_share: MismatchShare | None = Field(
        default=None, description="Relative error of the mass."
    )
    inertia_share: MismatchShare | None = Field(
        default=None, description="Relative error of each principal moment."
    )
    inertia_turn_deg: Degrees | None = Field(
        default=None,
        description="Turn of the principal axes against CRF (rotation vector), degrees.",
    )
    centre_of_mass_m: Offset | None = Field(
        default=None, description="Offset of the centre of mass from CRF's origin, m."
    )
    thrust_share: MismatchShare | None = Field(
        default=None,
        description="Relative error of each thruster's thrust; with ideal actuation, of force "
        "and torque per axis.",
    )
    thrust_turn_deg: Degrees | None = Field(
        default=None,
        description="Error of each thruster's direction; with ideal actuation, of force and "
        "torque (rotation vector), degrees.",
    )
    pulse_scatter_share: MismatchShare | None = Field(
        default=None,
        description="Relative scatter of each pulse's width, not below the minimum on-time; with "
        "ideal actuation, of each command per axis.",
    )
    force_N: Force | None = Field(
        default=None, description="Constant disturbance force at CRF's origin (body axes), N."
    )
    torque_N_m: Torque | None = Field(
        default=None, description="Constant disturbance torque (body axes), N m."
    )
    force_noise_N: Force | None = Field(
        default=None,
        description="Time-correlated disturbance force (body axes; Gauss-Markov process), N.",
    )
    torque_noise_N_m: Torque | None = Field(
        default=None,
        description="Time-correlated disturbance torque (body axes; Gauss-Markov process), N m.",
    )
    disturbance_time_s: Duration = Field(default=100.0, description="Correlation time of these, s.")
    delay_s: Seconds | None = Field(
        default=None,
        description="Delay of the actuators after the commanded time, s: this value, not drawn.",
    )
    delay_jitter_s: Seconds | None = Field(
        default=None, description="Standard deviation of that delay, s, drawn for each command."
    )
    clock_offset_s: Seconds | None = Field(
        default=None,
        description="Standard deviation of the chaser's clock against the world's, s: its "
        "actuators act earlier or later, but not before a command arrives.",
    )


class TargetTruth(Section):
    """Differences of the target. Figures are standard deviations per axis. Mass, inertia and centre
    of mass need `target.motion = "torque_free"`. A figure that is not given is that of the preset.
    """

    mass_share: MismatchShare | None = Field(
        default=None, description="Relative error of the mass."
    )
    inertia_share: MismatchShare | None = Field(
        default=None, description="Relative error of each principal moment."
    )
    inertia_turn_deg: Degrees | None = Field(
        default=None,
        description="Turn of the principal axes against TRF (rotation vector), degrees.",
    )
    centre_of_mass_m: Offset | None = Field(
        default=None, description="Offset of the centre of mass from TRF's origin, m."
    )
    marker_m: Annotated[float, Field(ge=0, le=0.02, allow_inf_nan=False)] | None = Field(
        default=None, description="Displacement of each marker in its plane, m."
    )


class CameraTruth(Section):
    """Camera errors in addition to `navigation.camera_*`, unknown to the flight software."""

    turn_deg: Degrees = Field(default=0.0, description="Rotation of the mounting, degrees.")
    shift_m: Metres = Field(default=0.0, description="Shift of the lens, m.")
    focal_share: FocalShare = Field(default=0.0, description="Relative error of the focal length.")
    centre_px: OffsetPixels = Field(
        default=0.0, description="Error of the principal point, pixels."
    )


class SensorTruth(Section):
    """Differences of the sensors' noise."""

    noise_factor: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = Field(
        default=1.0, description="True white noise of the odometry over the stated one."
    )


class LatchTruth(Section):
    """Imperfections of the latches: strength and play. By default a closed latch is rigid and holds
    any load.
    """

    strength_N: Positive | None = Field(
        default=None, description="Force on the port beyond which a closed latch opens, N."
    )
    strength_N_m: Positive | None = Field(
        default=None, description="Torque about the tip beyond which it opens, N m."
    )
    play_m: Annotated[float, Field(ge=0, le=0.01, allow_inf_nan=False)] = Field(
        default=0.0, description="Free travel of the tip in a closed latch, in any direction, m."
    )
    play_deg: Annotated[float, Field(ge=0, le=5, allow_inf_nan=False)] = Field(
        default=0.0,
        description="Free rotation of the chaser in a closed latch, about any axis, degrees.",
    )


class TruthValues(Section):
    """True values of one body, in place of drawn ones."""

    chaser: Index | None = Field(
        default=None, description="Number of the chaser, from 0; or `target`."
    )
    target: bool = Field(default=False, description="Whether these are the target's.")
    mass_kg: Positive | None = Field(default=None, description="Mass, kg.")
    inertia_kg_m2: Numbers6 | None = Field(
        default=None,
        description="Inertia tensor about the centre of mass in body axes, kg m²: xx, yy, zz, "
        "xy, xz, yz; or a symmetric 3 x 3 matrix.",
    )
    centre_of_mass_m: Vector | None = Field(
        default=None, description="Centre of mass (CRF or TRF), m."
    )
    force_N: Vector | None = Field(
        default=None, description="Constant force at the origin (body axes), N."
    )
    torque_N_m: Vector | None = Field(default=None, description="Constant torque (body axes), N m.")
    thrust_share: tuple[Annotated[float, Field(gt=-1, le=1)], ...] | None = Field(
        default=None,
        description="Relative error of every thruster's thrust; with ideal actuation, of force "
        "and torque (6).",
    )
    clock_offset_s: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        default=None, description="The chaser's clock minus the world's, s."
    )

    @model_validator(mode="before")
    @classmethod
    def _flatten_inertia(cls, values: Any) -> Any:
        """Accept a symmetric matrix for the inertia."""
        if not isinstance(values, Mapping):
            return values
        try:
            matrix = np.array(values.get("inertia_kg_m2"), dtype=float)
        except (TypeError, ValueError):
            return values
        if matrix.shape != (3, 3):
            return values
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
            raise ValueError("inertia_kg_m2: must be symmetric")
        xx, yy, zz = np.diag(matrix).tolist()
        return {
            **values,
            "inertia_kg_m2": (xx, yy, zz, *(float(matrix[i, j]) for i, j in _OFF_DIAGONAL)),
        }

    @model_validator(mode="after")
    def _check_body(self) -> TruthValues:
        if (self.chaser is None) == (not self.target):
            raise ValueError("give either chaser = N or target = true")
        only_chasers = ("force_N", "torque_N_m", "thrust_share", "clock_offset_s")
        if self.target and (
            key := next((k for k in only_chasers if getattr(self, k) is not None), None)
        ):
            raise ValueError(f"{key}: the target has none")
        if (inertia := self.inertia) is not None:
            moments = np.linalg.eigvalsh(inertia)
            if moments[0] <= 0 or 2 * moments[2] > moments.sum() * (1 + 1e-9):
                raise ValueError(
                    "inertia_kg_m2: no body has this inertia: its principal moments are "
                    f"{', '.join(f'{m:.4g}' for m in moments)}"
                )
        return self

    @property
    def inertia(self) -> np.ndarray[Any, np.dtype[np.float64]] | None:
        """The inertia tensor (3, 3)."""
        if self.inertia_kg_m2 is None:
            return None
        matrix = np.diag(self.inertia_kg_m2[:3])
        for (i, j), value in zip(_OFF_DIAGONAL, self.inertia_kg_m2[3:], strict=True):
            matrix[i, j] = matrix[j, i] = value
        return matrix


_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 2))  # places of the products of inertia xy, xz, yz


@dataclass(frozen=True)
class Mismatch:
    """Resolved figures of a chaser or the target, SI units and radians.

    Standard deviations per axis; ``delay_s`` is exact.
    """

    mass_share: float = 0.0
    inertia_share: float = 0.0
    inertia_turn_rad: float = 0.0
    centre_of_mass_m: float = 0.0
    thrust_share: float = 0.0
    thrust_turn_rad: float = 0.0
    pulse_scatter_share: float = 0.0
    force_N: float = 0.0
    torque_N_m: float = 0.0
    force_noise_N: float = 0.0
    torque_noise_N_m: float = 0.0
    disturbance_time_s: float = 100.0
    delay_s: float = 0.0
    delay_jitter_s: float = 0.0
    clock_offset_s: float = 0.0
    marker_m: float = 0.0


class TruthSection(Section):
    """Differences between the simulated world and the nominal values that the flight software
    assumes ([world.md](world.md)). Only the world, the recorder and analysis read them. By default
    there are none."""

    preset: Literal["nominal", "mismatch"] = Field(
        default="nominal",
        description="`nominal`: no differences. `mismatch`: mass 10 %, inertia 15 %, thrust 5 % "
        "and 1 degree, centre of mass 5 mm, force 5 mN, torque 0.5 mN m; target's inertia 15 "
        "%.",
    )
    chaser: ChaserTruth = ChaserTruth()
    target: TargetTruth = TargetTruth()
    camera: CameraTruth = CameraTruth()
    sensors: SensorTruth = SensorTruth()
    latch: LatchTruth = LatchTruth()
    values: tuple[TruthValues, ...] = ()
    oscillator: tuple[Oscillator, ...] = ()

    def mismatch(self, body: Literal["chaser", "target"]) -> Mismatch:
        """Return the figures of the chasers or of the target."""
        section = self.chaser if body == "chaser" else self.target
        preset = MISMATCH[body] if self.preset == "mismatch" else {}
        resolved: dict[str, float] = {}
        for key in type(section).model_fields:
            given: float | None = getattr(section, key)
            value = preset.get(key, 0.0) if given is None else given
            resolved[key.replace("_deg", "_rad")] = (
                math.radians(value) if key.endswith("_deg") else value
            )
        return Mismatch(**resolved)

    def values_of(self, chaser: int | None) -> TruthValues | None:
        """Return the explicit values of a chaser, or of the target for None."""
        return next((v for v in self.values if v.chaser == chaser), None)

    def oscillators(self, body: Literal["chaser", "target"]) -> tuple[Oscillator, ...]:
        """Return what each chaser, or the target, carries on springs."""
        return tuple(o for o in self.oscillator if o.body == body)
