# SPDX-License-Identifier: Apache-2.0
"""Ports that are too near to one another: refused, with the distance that would be right."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from chaserdock_models.shape_distance import swept_distance
from chaserdock_protocol.scenario import Scenario, ScenarioError, parse_scenario
from docking_cases import CHASERS, PORTS, values
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

TURNED = [0.9238795325112867, 0.3826834323650898, 0.0, 0.0]  # 45 degrees about the probe


def side_by_side(apart_m: float, *commands: tuple[str, int], **docking: Any) -> Scenario:
    """Return two chasers with ports in one plane, ``apart_m`` apart along z; a command every
    10 s.
    """
    second = PORTS[0] | {"chaser": 1, "position_m": [-0.2, 0.0, -0.05 + apart_m]}
    limits = {"min_distance_chasers_m": docking.pop("least_m", 0.35)}
    turned = docking.pop("q_wxyz", CHASERS[0]["q_wxyz"])
    changed: dict[str, Any] = values(
        2, docking={"ports": [PORTS[0], second], **docking}, limits=limits
    )
    chaser = CHASERS[0] | {"q_wxyz": turned}
    changed["chasers"] = [chaser, chaser | {"position_m": [-1.0, 0.0, 1.0]}]
    changed["timeline"] = [
        {"at_s": 10.0 * (k + 1), "command": what, "chasers": [i]}
        for k, (what, i) in enumerate(commands)
    ]
    return parse_scenario(changed, "test")


@pytest.mark.parametrize("at_once", [1, 2])
@pytest.mark.parametrize(
    ("apart_m", "docking", "reason"),
    [
        (0.18, {}, "the bodies of chasers 0 and 1 in their corridors overlap by"),
        (0.34, {}, "the bodies of chasers 0 and 1 in their corridors come within 0.01 m"),
        (0.40, {}, "come within 0.4 m, nearer than limits.min_distance_chasers_m (0.35 m) and 0.1"),
        (0.36, {"least_m": 0.2, "corridor": {"lateral_m": 0.001}}, None),
        (0.40, {"least_m": 0.2, "q_wxyz": TURNED}, "overlap by"),
    ],
)
def test_close_ports_are_refused_with_the_distance_that_fits(
    at_once: int, apart_m: float, docking: dict[str, Any], reason: str | None
) -> None:
    docking = docking | {"at_once": at_once}
    if reason is None:
        side_by_side(apart_m, **docking)
        return
    with pytest.raises(ScenarioError) as refused:
        side_by_side(apart_m, **docking)
    (line,) = str(refused.value).splitlines()
    assert f"docking.ports.0 and docking.ports.1, {apart_m:.3g} m apart" in line
    assert reason in line
    found = re.search(r"must be at least ([0-9.]+) m apart", line)
    assert found is not None
    least_m = float(found[1])
    side_by_side(least_m, **docking)
    with pytest.raises(ScenarioError):
        side_by_side(least_m - 0.002, **docking)


def test_close_ports_are_allowed_if_one_chaser_leaves_before_the_other_comes() -> None:
    after_it = [("approach", 0), ("retreat", 0), ("approach", 1)]
    side_by_side(0.18, *after_it)
    for commands in ([("approach", 0), ("approach", 1)], [*after_it, ("approach", 0)], []):
        with pytest.raises(ScenarioError, match="must be at least"):
            side_by_side(0.18, *commands)


def cuboid(values: list[float]) -> np.ndarray:
    """Return a row of a table of cuboids: centre (3,), rotation, half edges from 0.05 m on."""
    turn, _ = np.linalg.qr(np.reshape(values[3:12], (3, 3)) + 2.0 * np.eye(3))
    return np.concatenate([values[:3], turn.ravel(), 0.05 + np.abs(values[12:15])])


@given(st.lists(st.floats(-0.9, 0.9), min_size=36, max_size=36))
def test_a_swept_distance_is_positive_where_bodies_never_overlap_and_never_too_long(
    numbers: list[float],
) -> None:
    """The true distance is that of a least-squares problem over all points and times."""
    a, b = cuboid(numbers[:15]), cuboid(numbers[15:30])
    sweep_a, sweep_b = np.array(numbers[30:33]), np.array(numbers[33:36])
    edges = [
        *(r[3:12].reshape(3, 3) * r[12:] for r in (a, b)),
        (sweep_a / 2.0)[:, None],
        (sweep_b / 2.0)[:, None],
    ]
    apart = a[:3] + sweep_a / 2.0 - b[:3] - sweep_b / 2.0
    nearest = lsq_linear(np.hstack(edges), -apart, (-1.0, 1.0), tol=1e-14)
    true_m = float(np.linalg.norm(nearest.fun))
    gap_m = swept_distance(a[None], b[None], sweep_a, sweep_b)
    assert gap_m <= true_m + 1e-6
    assert true_m < 1e-5 or gap_m > 0.0
    np.testing.assert_allclose(gap_m, swept_distance(b[None], a[None], sweep_b, sweep_a), atol=1e-9)
