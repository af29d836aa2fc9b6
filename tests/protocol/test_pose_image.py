# SPDX-License-Identifier: Apache-2.0
"""Pose images of the perception ``statistical``."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models.arrays import Array
from chaserdock_protocol.pose_image import decode_pose, encode_pose

POSITION, ATTITUDE = np.array([0.1, -0.2, 1.5]), np.array([0.5, -0.5, 0.5, 0.5])


def decoded(
    attitude: Array, seed: tuple[int, int] = (7, 2**32 - 1)
) -> tuple[Array, Array, tuple[int, int]]:
    pixels = encode_pose(POSITION, attitude, seed)
    return decode_pose(np.frombuffer(pixels, dtype=np.uint8).reshape(1, -1))


def test_decoding_inverts_encoding() -> None:
    position, attitude, seed = decoded(ATTITUDE)
    np.testing.assert_array_equal(position, POSITION)
    np.testing.assert_array_equal(attitude, ATTITUDE)
    assert seed == (7, 2**32 - 1)


@pytest.mark.parametrize(
    "attitude", [ATTITUDE * 1.003, np.zeros(4), np.array([np.nan, 0.0, 0.0, 1.0])]
)
def test_an_attitude_that_is_no_rotation_is_refused(attitude: Array) -> None:
    with pytest.raises(ValueError, match="damaged image"):
        decoded(attitude)
