# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[ranging]``: what is measured of the target where the camera cannot measure
its pose.
"""

from __future__ import annotations

import math

from chaserdock_models.ranging import RangingErrors
from pydantic import Field

from .fields import Fraction, NotNegative, Positive, Section


class Ranging(Section):
    """Measurements at far range, of a target too small in the image for its markers. A range sensor
    measures its range, and a cooperative target sends its attitude; both have white errors. The
    bearing is measured in the image, where the target is the spot of the size that it has at that
    range. With `perception.name = "statistical"`, which has no image, the bearing is drawn with a
    white error. Markers are used in images in which they give the more accurate position
    ([estimation.md](estimation.md#far-range)). Without this section: a target whose markers are too
    small is not seen.
    """

    range_noise_m: Positive = Field(
        default=0.02, description="Standard deviation of the range, m, of a target nearby."
    )
    range_share: Fraction = Field(
        default=1e-4, description="Standard deviation of the range in addition, as a share of it."
    )
    attitude_noise_deg: Positive = Field(
        default=0.02,
        lt=90,
        description="Standard deviation of the attitude that the target sends, degrees.",
    )
    reach_m: NotNegative = Field(default=1000.0, description="Greatest range, m.")

    def errors(self) -> RangingErrors:
        """Return the errors in SI units and radians."""
        attitude = math.radians(self.attitude_noise_deg)
        return RangingErrors(self.range_noise_m, self.range_share, attitude, self.reach_m)
