# SPDX-License-Identifier: Apache-2.0
"""A small valid scenario for tests to change."""

from __future__ import annotations

import tomllib
from typing import Any

GOOD = """
name = "two"
duration_s = 10.0
seed = 3

[navigation]
grade = "exact"

[target]
model = "paper"

[[chasers]]
position_m = [-1.0, 0.0, 0.0]
q_wxyz = [1.0, 0.0, 0.0, 0.0]

[[chasers]]
position_m = [1.0, 0.0, 0.0]
q_wxyz = [0.0, 0.0, 0.0, 1.0]

[[timeline]]
at_s = 5.0
command = "hold"
chasers = [1]
"""


def good() -> dict[str, Any]:
    return tomllib.loads(GOOD)
