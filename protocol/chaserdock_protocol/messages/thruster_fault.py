# SPDX-License-Identifier: Apache-2.0
"""Operator command that injects thruster faults into the simulation."""

from __future__ import annotations

from msgspec import Struct

from .fields import ChaserId, Text, ThrusterId, ThrusterState


class ThrusterFaultCommand(Struct, frozen=True, kw_only=True):
    """Make a simulated thruster fail or repair it (``healthy``), if the scenario allows it.

    The chaser does not receive it. ``factor``, with ``weak`` only: remaining share of the thrust, 0 to 1.
    """

    chaser: ChaserId
    thruster: ThrusterId
    kind: ThrusterState
    factor: float | None = None
    operator: Text = ""
