"""What an operator asks of the world's thrusters, for tests."""

from __future__ import annotations

from msgspec import Struct

from .fields import ChaserId, Text, ThrusterId, ThrusterState


class ThrusterFaultCommand(Struct, frozen=True, kw_only=True):
    """An operator makes a thruster fail, or mends it (``healthy``), in the world: for tests, where the scenario allows it.

    The chaser is not told. ``factor`` goes with ``weak`` alone: what is left of the thruster's thrust, 0 to 1.
    """

    chaser: ChaserId
    thruster: ThrusterId
    kind: ThrusterState
    factor: float | None = None
    operator: Text = ""
