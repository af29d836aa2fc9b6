# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[docking]``: ports, approach corridors, and when a chaser counts as docked."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from .fields import Index, Positive, Section, UnitVector, Vector


class Port(Section):
    """The docking port of one chaser on the target."""

    chaser: Index = Field(description="Number of the chaser, from 0. At most one port per chaser.")
    position_m: Vector = Field(description="Where the probe's tip latches (TRF), m.")
    axis: UnitVector = Field(description="Outward axis of the port (TRF), unit vector.")
    force_limit_N: Positive | None = Field(
        default=None, description="Largest force that the latched chaser may exert on the port, N."
    )
    torque_limit_N_m: Positive | None = Field(
        default=None, description="Largest torque about the tip that it may exert on the port, N m."
    )


class Corridor(Section):
    """Limits relative to the port's axis at the end of the alignment and during the approach,
    before `final`.
    """

    lateral_m: Positive = Field(default=0.03, description="Lateral offset of the probe's tip, m.")
    angle_deg: Positive = Field(default=4.0, description="Attitude error, degrees.")
    lateral_speed_m_s: Positive = Field(
        default=0.02, description="Lateral speed of the probe's tip, m/s."
    )
    closing_m_s: Positive = Field(default=0.04, description="Closing speed, m/s.")
    rate_deg_s: Positive | None = Field(
        default=None, description="Rate relative to the target, degrees/s. Not set: not checked."
    )


CONTACT_CONDITIONS: dict[str, dict[str, float]] = {
    "idss": {
        "lateral_m": 0.10,
        "angle_deg": 4.0,
        "lateral_speed_m_s": 0.04,
        "closing_m_s": 0.10,
        "rate_deg_s": 0.20,
    },
    "atv": {"lateral_m": 0.10, "closing_m_s": 0.10},
    "soyuz": {"closing_m_s": 0.15},
}
"""Contact conditions by preset. ``idss``: International Docking System Standard, Interface
Definition Document, revision E, October 2016, table 3.3.1.1-2 (closing 0.05 to 0.10 m/s; the
smaller bound is not checked); low-impact docking systems as NASA's NDS follow it. ``atv``: ESA,
"One hour to docking", 24 February 2011 (blogs.esa.int/orion): within 10 cm, and at less than 10
cm/s; it states nothing else. ``soyuz``: S. Cristoforetti, logbook L-210, "Passed my manual docking
exam", ESA (outpost42.esa.int): manual docking within the allowed range of 6 to 15 cm/s (the smaller
bound is not checked); it states nothing else."""

Preset = Literal["none", "idss", "atv", "soyuz"]
_PRESET_TEXT = (
    "Contact conditions of a docking system, in place of the defaults of the keys that it "
    "states; keys that are given override it "
    "([docking.md](docking.md#contact-conditions-of-docking-systems))."
)


class _ContactConditions(Corridor):
    """Limits at contact that a preset can fill in."""

    preset: Preset = Field(default="none", description=_PRESET_TEXT)

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, values: Any) -> Any:
        stated = (
            CONTACT_CONDITIONS.get(values.get("preset", "none"))
            if isinstance(values, dict)
            else None
        )
        return values if stated is None else stated | values


class Final(_ContactConditions):
    """Limits over the last `final_m`. The closing speed is checked once the chaser has slowed
    down.
    """

    lateral_m: Positive = Field(default=0.008, description="Lateral offset of the probe's tip, m.")
    angle_deg: Positive = Field(default=2.0, description="Attitude error, degrees.")
    lateral_speed_m_s: Positive = Field(
        default=0.008, description="Lateral speed of the probe's tip, m/s."
    )
    closing_m_s: Positive = Field(default=0.016, description="Closing speed, m/s.")


class Tolerances(_ContactConditions):
    """Errors at contact up to which the latch closes."""

    lateral_m: Positive = Field(default=0.01, description="Lateral offset of the probe's tip, m.")
    angle_deg: Positive = Field(default=3.0, description="Attitude error, degrees.")
    lateral_speed_m_s: Positive = Field(
        default=0.01, description="Lateral speed of the probe's tip, m/s."
    )
    closing_m_s: Positive = Field(default=0.02, description="Closing speed at contact, m/s.")


class Docking(Section):
    """How docking ends. Distances are between the probe's tip and the port, along the port's
    axis.
    """

    # Figures of the procedure that are no keys: flight software and its checks share them.
    overdrive_m: ClassVar[float] = 0.03
    """How far the reference continues behind the port, m: three times the lateral tolerance at
    contact, so that an error along the axis does not end the approach before the port."""
    approach_timeout_s: ClassVar[float] = 60.0
    """Longest approach to the last part, s: six times 0.25 m at 0.025 m/s."""
    final_timeout_s: ClassVar[float] = 30.0
    """Longest last part, s: about twice 0.13 m, with the overdrive, at 0.01 m/s."""
    contact_timeout_s: ClassVar[float] = 5.0
    """Longest contact without a latch, s: some rebounds of the probe of 1 cm at 0.01 m/s."""
    corridor_margin_m: ClassVar[float] = 0.1
    """A chaser waits if its corridor comes nearer to one in use, between body centres, than the
    least distance between chasers and this, m: both may be 0.03 m off (`corridor.lateral_m`), and
    need some cm to brake."""
    settle_s: ClassVar[float] = 2.0
    """Wait between the latch and the pull test, s: 30 ticks of the default rate for estimates."""
    pull_s: ClassVar[float] = 1.0
    """Duration of the pull, and of the push that follows it, s: 0.5 N move 30 kg by 17 mm if the
    latch is open, more than `verify_position_m`."""
    verify_position_m: ClassVar[float] = 0.005
    """Largest displacement in the pull test, m: half of the lateral tolerance at contact."""
    pull_clearance: ClassVar[float] = 1.5
    """Least motion of an open latch in the pull test, over `verify_position_m`: beyond it by three
    standard deviations of a change of the estimate in `docking-contact` (0.74 mm)."""
    verify_angle_deg: ClassVar[float] = 0.5
    """Largest rotation in the pull test, degrees: a sixth of the tolerance at contact."""

    kind: Literal["held", "capture"] = Field(
        default="held",
        description="`held`: the chaser holds at a distance, within the tolerances of "
        "`[approach]`, as in the paper. `capture`: it flies into its port and is latched.",
    )
    ports: tuple[Port, ...] = ()
    entry_m: Positive = Field(
        default=0.35, description="Distance at which a corridor begins, m. Longer than `final_m`."
    )
    final_m: Positive = Field(
        default=0.10, description="Length of the last part, flown at `contact_speed_m_s`, m."
    )
    approach_speed_m_s: Positive = Field(
        default=0.025, description="Speed of the reference before the last part, m/s."
    )
    contact_speed_m_s: Positive = Field(
        default=0.01,
        description="Speed of the reference in the last part, m/s. At most `approach_speed_m_s`.",
    )
    corridor: Corridor = Corridor()
    corridor_angle_deg: float = Field(
        default=20.0,
        gt=0.0,
        lt=90.0,
        allow_inf_nan=False,
        description="Half angle of the cone about the corridor's axis in which a chaser on its "
        "way in or out is planned, degrees. It replaces `limits.min_distance_target_m` for "
        "that chaser.",
    )
    final: Final = Final()
    tolerances: Tolerances = Tolerances()
    at_once: int = Field(
        default=2, ge=1, description="Most chasers on their way in at the same time; others wait."
    )
    attempts: int = Field(default=3, ge=1, le=100, description="Attempts before a chaser gives up.")
    align_timeout_s: Positive = Field(
        default=60.0, description="Longest alignment before the corridor, s."
    )
    pull_N: Positive = Field(default=0.5, description="Force of the pull test, N.")

    @model_validator(mode="after")
    def _check_consistent(self) -> Docking:
        if self.kind == "capture" and not self.ports:
            raise ValueError("kind capture needs at least one of [[docking.ports]]")
        chasers = [port.chaser for port in self.ports]
        for chaser in chasers:
            if chasers.count(chaser) > 1:
                raise ValueError(f"ports: chaser {chaser} has more than one")
        if self.final_m >= self.entry_m:
            raise ValueError(
                f"final_m ({self.final_m:g}) must be less than entry_m ({self.entry_m:g})"
            )
        if self.contact_speed_m_s > self.approach_speed_m_s:
            raise ValueError(
                f"contact_speed_m_s ({self.contact_speed_m_s:g}) must not exceed "
                f"approach_speed_m_s ({self.approach_speed_m_s:g})"
            )
        return self

    def open_latch_motion_m(self, mass_kg: float) -> float:
        """Return how far pull and push move a chaser whose latch is open, at least, m.

        Two equal and opposite pulses leave it at rest, ``pull_s`` x its highest speed away.
        """
        return self.pull_N * self.pull_s**2 / mass_kg

    def port_of(self, chaser: int) -> Port | None:
        """Return the port where a chaser is to be captured, or None."""
        if self.kind != "capture":
            return None
        return next((port for port in self.ports if port.chaser == chaser), None)
