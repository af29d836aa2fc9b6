"""What an operator asks of the world's jets, for tests."""

from __future__ import annotations

from msgspec import Struct

from .fields import ChaserId, JetId, JetState, Text


class JetFaultCommand(Struct, frozen=True, kw_only=True):
    """An operator makes a jet fail, or mends it (``healthy``), in the world: for tests, where the scenario allows it.

    The chaser is not told. ``factor`` goes with ``weak`` alone: what is left of the jet's thrust, 0 to 1.
    """

    chaser: ChaserId
    jet: JetId
    kind: JetState
    factor: float | None = None
    operator: Text = ""
