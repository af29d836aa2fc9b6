# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[assurance]``: a filter in each chaser that lets no command do harm."""

from __future__ import annotations

from pydantic import Field

from .fields import Positive, Section


class AssuranceSection(Section):
    """Each chaser changes commands that would lead out of its safe set, whoever sends them
    ([assurance.md](assurance.md)). Without this section: commands are given as they come."""

    braking_share: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        allow_inf_nan=False,
        description="Share of the least force along any axis with which a chaser counts on "
        "braking. The rest is for errors of mass and thrust, disturbances, and for braking in "
        "several directions at once.",
    )
    max_rate_deg_s: Positive = Field(
        default=15.0, description="Largest rate of a chaser about any axis, degrees/s."
    )
