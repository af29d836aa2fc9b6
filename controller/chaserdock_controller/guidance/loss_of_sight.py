"""What a chaser does when nobody sees the target any more, before the estimate itself is lost. Pure.

Whoever comes nearer stops doing so: in a port's corridor it backs off, else it holds, and goes on when the target is seen
again. Whoever holds, moves about at a distance or backs off already goes on by the estimate, and who touches or holds on
to the target does, too.
"""

from __future__ import annotations

from typing import Literal

VISION_S = 3.0
"""Unseen for so long by everybody, the target is no more approached."""
BLIND = f"nobody has seen the target for {VISION_S:g} s"
SEEN = "the target is seen again"


def on_loss(phase: str, port: bool, unseen_s: float) -> Literal["hold", "back off"] | None:
    """What a chaser is to do instead of its ``phase``, or None; ``port``: whether it docks at one."""
    if unseen_s < VISION_S:
        return None
    if port and phase in ("align", "approach", "final"):
        return "back off"
    return "hold" if phase == "approach" else None


def goes_on(phase: str, held: bool, unseen_s: float) -> bool:
    """Whether a chaser that was ``held`` for want of sight approaches again."""
    return held and phase == "hold" and unseen_s == 0.0
