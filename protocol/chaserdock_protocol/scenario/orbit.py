# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[orbit]``: the target's orbit, known to flight software."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Annotated, Any

from chaserdock_models.orbit import EARTH_J2, EARTH_RADIUS_M, OrbitalElements
from pydantic import BeforeValidator, Field, model_validator

from .fields import Positive, Section

LOWEST_ALTITUDE_M = 100e3
"""Where the table of the atmosphere begins; below, no orbit lasts for a revolution."""
LARGEST_SEMI_AXIS_M = 1e8
"""Longest semi-major axis, m: more than twice a geostationary orbit's. Coasts of two orbits, which
passive safety samples, then last a week; far beyond, they fill the memory.
"""
Angle = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]


def _moment(value: Any) -> Any:
    """Parse an ISO 8601 moment, which JSON and overrides give as text."""
    if not isinstance(value, str):
        return value
    try:
        return datetime.fromisoformat(value)
    except ValueError:
        raise ValueError(f"must be a moment such as 2026-03-20T12:00:00Z, not {value!r}") from None


class Orbit(Section):
    """The target's orbit: WRF is its Hill frame ([frames.md](frames.md#orbit)). Without this
    section: free space, and WRF is inertial. Give either `altitude_m` for a circular orbit, or
    `semi_major_axis_m`."""

    altitude_m: Positive | None = Field(
        default=None, description="Altitude of a circular orbit above the equatorial radius, m."
    )
    semi_major_axis_m: Positive | None = Field(default=None, description="Semi-major axis, m.")
    eccentricity: float = Field(
        default=0.0,
        ge=0,
        le=0.1,
        allow_inf_nan=False,
        description="Eccentricity. Flight software assumes a circular orbit.",
    )
    inclination_deg: float = Field(
        default=51.6, ge=0, le=180, allow_inf_nan=False, description="Inclination, degrees."
    )
    ascending_node_deg: Angle = Field(
        default=0.0, description="Right ascension of the ascending node, degrees."
    )
    perigee_argument_deg: Angle = Field(default=0.0, description="Argument of perigee, degrees.")
    true_anomaly_deg: Angle = Field(
        default=0.0, description="True anomaly at the begin of the mission, degrees."
    )
    epoch: Annotated[datetime, BeforeValidator(_moment)] = Field(
        default=datetime(2026, 3, 20, 12, tzinfo=UTC),
        description="Begin of the mission, with a time zone. The direction to the sun depends on "
        "it.",
    )
    j2: bool = Field(
        default=True,
        description="Whether the Earth's oblateness acts; if not, its gravity is a point's.",
    )
    target_ballistic_coefficient_kg_m2: Positive | None = Field(
        default=None,
        description="Mass of the target over its drag coefficient and area, kg/m². Without both "
        "this and the chasers': no differential drag.",
    )
    chaser_ballistic_coefficient_kg_m2: Positive | None = Field(
        default=None, description="The same of a chaser, kg/m²."
    )

    @model_validator(mode="after")
    def _check_section(self) -> Orbit:
        if (self.altitude_m is None) == (self.semi_major_axis_m is None):
            raise ValueError("give either altitude_m or semi_major_axis_m")
        if self.altitude_m is not None and self.eccentricity:
            raise ValueError(
                "altitude_m: is of a circular orbit; give semi_major_axis_m with an eccentricity"
            )

        if self.epoch.tzinfo is None:
            raise ValueError(f"epoch: needs a time zone, as in {self.epoch.isoformat()}Z")
        if not 1950 <= self.epoch.year <= 2050:
            raise ValueError(f"epoch: must be in the years 1950 to 2050, not {self.epoch.year}")

        lowest_m = self.elements.perigee_radius_m - EARTH_RADIUS_M
        if lowest_m < 0.0:
            raise ValueError(
                f"the orbit lies inside the Earth: its perigee is {-lowest_m / 1e3:.1f} km below "
                f"the surface (radius {EARTH_RADIUS_M / 1e3:.1f} km)"
            )
        if lowest_m < LOWEST_ALTITUDE_M:
            raise ValueError(
                f"the perigee is at {lowest_m / 1e3:.1f} km, inside the atmosphere; at least "
                f"{LOWEST_ALTITUDE_M / 1e3:g} km are needed"
            )

        if self.elements.semi_major_axis_m > LARGEST_SEMI_AXIS_M:
            raise ValueError(
                f"the semi-major axis is {self.elements.semi_major_axis_m / 1e3:.6g} km; at most "
                f"{LARGEST_SEMI_AXIS_M / 1e3:g} km"
            )

        drag = (self.target_ballistic_coefficient_kg_m2, self.chaser_ballistic_coefficient_kg_m2)
        if drag.count(None) == 1:
            raise ValueError(
                "target_ballistic_coefficient_kg_m2, chaser_ballistic_coefficient_kg_m2: give "
                "both or none"
            )
        return self

    @property
    def elements(self) -> OrbitalElements:
        """Osculating elements at the begin of the mission."""
        radius_m = (
            EARTH_RADIUS_M + self.altitude_m
            if self.altitude_m is not None
            else self.semi_major_axis_m
        )
        assert radius_m is not None
        return OrbitalElements(
            radius_m,
            self.eccentricity,
            math.radians(self.inclination_deg),
            math.radians(self.ascending_node_deg),
            math.radians(self.perigee_argument_deg),
            math.radians(self.true_anomaly_deg),
        )

    @property
    def zonal_coefficient(self) -> float:
        """J2 of the Earth's gravity, or 0 of a point's."""
        return EARTH_J2 if self.j2 else 0.0
