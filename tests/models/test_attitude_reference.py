# SPDX-License-Identifier: Apache-2.0
"""Reference attitudes that face the target's centre from any direction."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.rotations import to_matrix

IDENTITY = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "nominal", [(1.0, 0.0, 0.0), (0.0, 0.0, -2.0), (0.6, -0.3, 0.5), (0.1, 0.2, 1.5)]
)
def test_attitude_turns_the_nominal_direction_to_that_of_the_offset(
    nominal: tuple[float, float, float],
) -> None:
    """Also by a half turn, about an axis that is perpendicular to an oblique direction."""
    a = np.array(nominal) / np.linalg.norm(nominal)
    offsets = np.array([nominal, -np.array(nominal), (0.2, 0.9, -0.4)])
    for offset, q in zip(offsets, facing_attitudes(nominal, IDENTITY, offsets), strict=True):
        np.testing.assert_allclose(to_matrix(q) @ a, offset / np.linalg.norm(offset), atol=1e-12)


def test_attitude_at_the_centre_is_the_nominal_one() -> None:
    q = np.array([0.5, 0.5, -0.5, 0.5])
    np.testing.assert_allclose(
        facing_attitudes((1.0, 0.0, 0.0), q, [(0.0, 0.0, 0.0)])[0], q, atol=1e-12
    )
