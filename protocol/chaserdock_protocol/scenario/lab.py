# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[lab]``: the devices of a laboratory that `chaserdock gateway` connects to a
mission in place of the simulated world. The world ignores it, so that the same file flies the
simulation twin.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from .fields import (
    MAX_CHASERS,
    Index,
    NotNegative,
    Oriented,
    Positive,
    Section,
    UnitQuaternion,
    Vector,
)

if TYPE_CHECKING:
    from . import Scenario


class LabDevice(Section):
    """A device, and how to reach it."""

    address: str = Field(
        min_length=3,
        max_length=400,
        description="`SCHEME:ADDRESS`; the scheme names the driver "
        "([devices.md](devices.md)), as in `ros2:/robot0/odom`.",
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="Options of the driver ([devices.md](devices.md))."
    )


class LabAxes(Oriented):
    """Axes in which a device states poses."""

    world_axes: Literal["enu", "ned"] = Field(
        default="enu",
        description="World axes of the device: `enu` (z up), which are those of WRF, or `ned` "
        "(z down).",
    )
    body_axes: Literal["flu", "frd"] = Field(
        default="flu",
        description="Body axes of the device: `flu` (x forward, z up), or `frd` (z down).",
    )


class LabCamera(LabDevice):
    """The camera of a chaser."""

    chaser: Index = Field(description="Number of the chaser.")
    latency_s: NotNegative = Field(
        default=0.0,
        le=1.0,
        description="Shortest time from the middle of an exposure to the arrival of the image, s: "
        "what the clock's estimate cannot tell from an offset.",
    )
    stamp: Literal["device", "arrival"] = Field(
        default="device",
        description="`device`: the camera states when it exposes, by a clock of its own. "
        "`arrival`: it does not; images count as exposed `latency_s` before they arrive.",
    )


class LabPose(LabDevice, LabAxes):
    """Poses of one body, by odometry or motion capture."""

    body: str = Field(
        pattern=r"^(target|chaser/(0|[1-9][0-9]?))$",
        description="Whose pose: `target` or `chaser/N`.",
    )
    name: str = Field(
        default="", description="The device's name of the body; empty if it states one body only."
    )
    position_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Origin of CRF (or TRF) in the axes of the measured body, x forward and z up, "
        "m.",
    )
    q_wxyz: UnitQuaternion = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="Attitude of CRF (or TRF) in the axes of the measured body.",
    )
    sigma_m: Positive = Field(
        default=5e-4, description="Noise of a position, m, where the device states none."
    )
    sigma_deg: Positive = Field(
        default=0.05, description="Noise of an attitude, degrees, where the device states none."
    )
    velocity_sigma_m_s: Positive = Field(
        default=0.005, description="Noise of a velocity that the device states, m/s."
    )
    rate_sigma_deg_s: Positive = Field(
        default=0.2, description="Noise of a rate that the device states, degrees/s."
    )
    latency_s: NotNegative = Field(
        default=0.0,
        le=1.0,
        description="Shortest time from a measurement to its arrival, s.",
    )


class LabRobot(LabDevice):
    """The actuators of a chaser."""

    chaser: Index = Field(description="Number of the chaser.")
    body_axes: Literal["flu", "frd"] = Field(
        default="flu", description="Axes in which the robot takes forces and torques."
    )


class LabLatch(LabDevice):
    """The docking sensor and latch of a chaser."""

    chaser: Index = Field(description="Number of the chaser.")


class Volume(Section):
    """A box in WRF."""

    lower_m: Vector = Field(description="Lowest coordinates, m.")
    upper_m: Vector = Field(description="Highest coordinates, m.")

    @model_validator(mode="after")
    def _check_order(self) -> Volume:
        if not all(a < b for a, b in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError("lower_m must be below upper_m on every axis")
        return self


class LabSafety(Section):
    """Limits that the gateway enforces, whatever the controller says."""

    volume: Volume = Field(description="Where the centres of the robots must stay, WRF.")
    max_speed_m_s: Positive = Field(description="Largest speed of a robot, m/s.")
    max_rate_deg_s: Positive = Field(default=60.0, description="Largest rate, degrees/s.")
    max_force_N: Positive | None = Field(
        default=None,
        description="Largest force on a robot, N; a larger one is scaled. Without it: what the "
        "chaser can give.",
    )
    max_torque_N_m: Positive | None = Field(
        default=None, description="Largest torque, N m, likewise."
    )
    stale_s: Positive = Field(
        default=0.2,
        le=5.0,
        description="Age of the odometry, or of the command, of a robot at which it is stopped, s.",
    )
    max_unexplained_m_s2: Positive = Field(
        default=0.05,
        description="Largest acceleration of a robot, averaged over 3 s, that its commands do not "
        "explain, m/s²: it does not obey, or is pushed.",
    )
    jump_m: Positive = Field(
        default=0.05,
        description="Difference of a position from where the body can have got that counts as a "
        "jump of the odometry, m.",
    )


class LabSection(Section):
    """Devices of a laboratory, and what must never happen in it."""

    safety: LabSafety
    camera: tuple[LabCamera, ...] = Field(default=(), max_length=MAX_CHASERS)
    odometry: tuple[LabPose, ...] = Field(min_length=1, max_length=MAX_CHASERS)
    robot: tuple[LabRobot, ...] = Field(min_length=1, max_length=MAX_CHASERS)
    latch: tuple[LabLatch, ...] = Field(default=(), max_length=MAX_CHASERS)
    reference: tuple[LabPose, ...] = Field(
        default=(),
        max_length=MAX_CHASERS + 1,
        description="Poses by motion capture that flight software does not receive: results are "
        "evaluated against them.",
    )


def check_lab(scenario: Scenario) -> None:
    """Check the devices against the chasers. Raises ValueError."""
    lab = scenario.lab
    if lab is None:
        return
    chasers = {f"chaser/{i}" for i in range(len(scenario.chasers))}
    bodies = [pose.body for pose in lab.odometry]
    _check_each("odometry", bodies, chasers, chasers)
    _check_each("robot", (f"chaser/{r.chaser}" for r in lab.robot), chasers, chasers)
    _check_each("camera", (f"chaser/{c.chaser}" for c in lab.camera), chasers, set())
    with_port = {
        f"chaser/{i}"
        for i in range(len(scenario.chasers))
        if scenario.docking.port_of(i) is not None
    }
    _check_each("latch", (f"chaser/{x.chaser}" for x in lab.latch), with_port, with_port)
    _check_each("reference", (pose.body for pose in lab.reference), {*chasers, "target"}, set())


def _check_each(key: str, named: Iterable[str], allowed: set[str], needed: set[str]) -> None:
    """Raise ValueError unless ``named`` are distinct, ``allowed`` and contain the ``needed``."""
    counts = Counter(named)
    if unknown := sorted(set(counts) - allowed):
        raise ValueError(
            f"lab.{key}: {', '.join(unknown)}: must be among {', '.join(sorted(allowed)) or 'none'}"
        )
    if twice := [name for name, n in counts.items() if n > 1]:
        raise ValueError(f"lab.{key}: {', '.join(twice)} more than once")
    if missing := sorted(needed - set(counts)):
        raise ValueError(f"lab.{key}: {', '.join(missing)} missing")
