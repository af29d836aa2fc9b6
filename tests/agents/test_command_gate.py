# SPDX-License-Identifier: Apache-2.0
"""The pilot: which commands a chaser refuses to fly, and how it brakes."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.command_gate import brake_command, passed_on, refusal
from chaserdock_models import rotations
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.messages import Odometry, WrenchCommand
from chaserdock_protocol.scenario.bodies import Body
from flight_cases import odometry, start

BODY = Body()
COMMAND = WrenchCommand(
    tick=5,
    sim_time_ns=300_000_000,
    chaser=1,
    effective_time_ns=333_000_000,
    expires_ns=800_000_000,
    mode="nmpc",
    force_N=(2.0, -2.0, 0.5),
    torque_N_m=(0.05, 0.0, -0.05),
)


def why_not(last_tick: int = 4, now_ns: int = 300_000_000, **changes: Any) -> str | None:
    return refusal(
        msgspec.structs.replace(COMMAND, **changes), 1, BODY, last_tick, now_ns, 333_000_000
    )


def test_a_good_command_is_flown_as_it_is() -> None:
    assert why_not() is None
    assert why_not(now_ns=799_999_999) is None
    assert why_not(last_tick=-1) is None
    assert why_not(force_N=(2.0 * 1.009, 0.0, 0.0)) is None  # rounding at the limit
    assert (
        why_not(effective_time_ns=833_000_000) is None
    )  # a clock that is ahead by a command's lifetime
    flown = passed_on(COMMAND)
    assert flown.source == "command"
    for field in ("tick", "sim_time_ns", "chaser", "effective_time_ns", "force_N", "torque_N_m"):
        assert getattr(flown, field) == getattr(COMMAND, field)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"chaser": 0}, "addressed to chaser 0"),
        ({"last_tick": 5}, "a command for tick 5 was already executed"),
        ({"last_tick": 9}, "for tick 5, but a command for tick 9"),
        ({"now_ns": 800_000_000}, "expired at 0.800 s, now 0.800 s"),
        ({"now_ns": 900_000_000}, "expired at 0.800 s, now 0.900 s"),
        (
            {"effective_time_ns": 833_000_001},
            "takes effect at 0.833 s, commands for tick 5 do at 0.333 s",
        ),
        ({"force_N": (0.0, -2.03, 0.0)}, "force of 2.03 N exceeds the body's 2 N"),
        ({"force_N": (0.0, 0.0, 1e9)}, "force of 1e+09 N exceeds"),
        ({"torque_N_m": (0.0, 0.0, -0.0506)}, "torque of 0.0506 N m exceeds the body's 0.05 N m"),
    ],
)
def test_invalid_command_is_refused_with_the_reason(changes: dict[str, Any], reason: str) -> None:
    refused = why_not(**changes)
    assert refused is not None
    assert reason in refused


@pytest.mark.parametrize("seed", range(4))
def test_braking_brings_a_chaser_to_rest_within_its_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = start(seed)
    x[3:6] = rng.uniform(-0.3, 0.3, 3)
    x[10:13] = rng.uniform(-0.2, 0.2, 3)
    speeds = []
    for k in range(600):
        o = Odometry(
            tick=k,
            sim_time_ns=k,
            chaser=3,
            position_m=tuple(x[:3].tolist()),
            velocity_m_s=tuple(x[3:6].tolist()),
            q_wxyz=tuple(x[6:10].tolist()),
            omega_rad_s=tuple(x[10:13].tolist()),
        )
        command = brake_command(o, BODY, 77)
        assert (command.chaser, command.tick, command.effective_time_ns, command.source) == (
            3,
            k,
            77,
            "brake",
        )
        assert max(map(abs, command.force_N)) <= BODY.force_max_N
        assert max(map(abs, command.torque_N_m)) <= BODY.torque_max_N_m
        x = propagate(x, np.array([*command.force_N, *command.torque_N_m]), BODY, 1 / 15)
        speeds.append((np.linalg.norm(x[3:6]), np.linalg.norm(x[10:13])))
    assert speeds[-1][0] < 1e-3
    assert speeds[-1][1] < 1e-4
    assert all(b[0] <= a[0] + 1e-12 for a, b in pairwise(speeds))


def test_braking_in_body_axes_pushes_against_the_motion_in_the_world() -> None:
    quarter = rotations.exp([0.0, 0.0, math.pi / 2])
    o = odometry(
        velocity_m_s=(0.0, 0.03, 0.0), q_wxyz=tuple(quarter.tolist()), omega_rad_s=(0.0, 0.0, 0.0)
    )
    force = brake_command(o, BODY, 0).force_N
    assert force[0] == pytest.approx(-0.3)  # world y is the body's x; 30 kg and three seconds
    np.testing.assert_allclose(force[1:], 0.0, atol=1e-12)


def test_commanded_thrusts_must_fit_the_thrusters() -> None:
    body = Body(body="tetra12", actuation="thrusters")
    # The wrench of single thrusters may exceed what is available on all axes at once.
    base = msgspec.structs.replace(COMMAND, mode="detumble", force_N=(5.0, 0.0, 0.0))

    def why(thrusts_N: tuple[float, ...], of: Body = body) -> str | None:
        command = msgspec.structs.replace(base, thrusts_N=thrusts_N)
        return refusal(command, 1, of, 4, 300_000_000, 333_000_000)

    assert why((1.5,) * 12) is None
    assert why((1.5,) * 11) == "thrusts of 11 thrusters, but the body has 12"
    assert why((1.5,) * 12, BODY) == "thrusts of 12 thrusters, but the body has 0"
    for wrong in (1.6, -0.1, math.nan):
        reason = why((*(0.0,) * 3, wrong, *(0.0,) * 8))
        assert reason is not None
        assert "thruster 3" in reason
    assert "exceeds the body's" in str(why(()))
