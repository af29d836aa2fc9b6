# SPDX-License-Identifier: Apache-2.0
"""Define the interface of a rigid-body engine: what the simulation needs of PyBullet or MuJoCo.

Bodies are numbered in the order in which they were defined. The frame of a body is that of its
principal axes at its centre of mass. Quaternions are scalar first, body to world; rates are in
world axes, as an engine's loop over steps needs them. Where a call takes or returns sequences of
floats, not arrays, it runs for every body in every step.

There is no gravity, damping or sleeping. All engines integrate alike: a load acts for one step, on
the state at its beginning, and the step moves a body with the velocity and rate at its end
(semi-implicit Euler). The gyroscopic torque is that at the beginning of the step, which
gyroscopic.py corrects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.orbit import Scalars3
from chaserdock_models.rigid_body import BodyState

Scalars4 = tuple[float, float, float, float]
BodyMotion = tuple[Scalars3, Scalars4, Scalars3, Scalars3]
"""Position (3,), m, attitude (4,), velocity (3,), m/s, and rate (3,), rad/s, of a body in WRF."""


@dataclass(frozen=True, eq=False)
class SolidBox:
    """A cuboid with half edges ``half_m`` (3,).

    ``position_m`` (3,) and ``q_wxyz`` (4,): its pose in the frame of the body.
    """

    half_m: Sequence[float]
    position_m: Array
    q_wxyz: Array


@dataclass(frozen=True, eq=False)
class SolidCapsule:
    """A cylinder of ``length_m`` along z with round ends of ``radius_m``; posed as a
    ``SolidBox``.
    """

    radius_m: float
    length_m: float
    position_m: Array
    q_wxyz: Array


@dataclass(frozen=True, eq=False)
class SolidHull:
    """The convex hull of ``vertices_m`` (n, 3) in the frame of the body.

    Triangles (m, 3); none for points in a plane.
    """

    vertices_m: Array
    triangles: IntArray


CollisionSolid = SolidBox | SolidCapsule | SolidHull


@dataclass(frozen=True, eq=False)
class RigidBodyDefinition:
    """A body with principal moments ``moments_kg_m2`` (3,), its collision shape and initial state.

    ``mass_kg``: 0 for a body that moves only where it is placed.
    """

    mass_kg: float
    moments_kg_m2: Sequence[float]
    solids: Sequence[CollisionSolid]
    state: BodyState


@dataclass(frozen=True)
class ContactSpring:
    """Compliance of each body in a contact: stiffness along the normal, N/m, and damping, N s/m.

    In a contact of two bodies the stiffnesses are in series, half of one, and the dampings add up,
    as in PyBullet. ``mass_kg``: effective mass of the contact, for engines that state contacts per
    mass.
    """

    stiffness_N_m: float
    damping_N_s_m: float
    mass_kg: float


@dataclass(frozen=True, eq=False)
class EngineSetup:
    """The bodies of a simulation with steps of ``step_s``.

    ``spring``: compliance of all contacts; None: they are hard and do not rebound. ``joints``:
    pairs of bodies that a rigid joint may hold.
    """

    bodies: Sequence[RigidBodyDefinition]
    step_s: float
    spring: ContactSpring | None = None
    joints: Sequence[tuple[int, int]] = ()


@dataclass(frozen=True, eq=False)
class PlacementPath:
    """States at which a body is placed: after step ``first`` from now, and then every ``every``
    steps.

    ``states``: position (K, 3), velocity (3,), attitude (K, 4) and rate (3,) of K placements.
    """

    body: int
    first: int
    every: int
    states: BodyState

    def placement(self, steps: int) -> BodyState | None:
        """Return the state at which the body is placed after this many steps, or None."""
        k, rest = divmod(steps - self.first, self.every)
        if rest or k < 0:
            return None
        s = self.states
        return BodyState(s.position_m[k], s.velocity_m_s, s.q_wxyz[k], s.omega_rad_s)


class BodyContact(NamedTuple):
    """Two bodies in contact, and the point (3,), WRF, on the surface of each."""

    a: int
    b: int
    point_a_m: Sequence[float]
    point_b_m: Sequence[float]


class RigidBodyEngine(Protocol):
    """Simulate rigid bodies, their contacts and joints. Loads are cleared after each step."""

    def motion(self, body: int) -> BodyMotion:
        """Return the present motion of a body."""
        ...

    def place(self, body: int, state: BodyState) -> None:
        """Set the state of a body."""
        ...

    def push(self, body: int, force: Sequence[float], torque: Sequence[float]) -> None:
        """Apply force and torque (3,) each at the centre of mass, in the axes of the body, for the
        next step.
        """
        ...

    def push_at(
        self, body: int, force: Sequence[float], torque: Sequence[float], point_m: Sequence[float]
    ) -> None:
        """Apply a force (3,) at a point (3,) and a torque (3,), all in WRF, for the next step."""
        ...

    def step(self) -> None:
        """Make one step."""
        ...

    def advance(
        self, bodies: IntArray, loads: Array, steps: int, path: PlacementPath | None = None
    ) -> tuple[int, bool]:
        """Step free ``bodies`` (n,) under constant loads at most ``steps`` times.

        Stops after a step with contacts. ``loads`` (n, 9): principal moments, force and torque in
        body axes; gyroscopic.py corrects the torque. ``path``: of another body; its placement after
        a step with contacts is left to the caller. Return the number of steps made, and whether
        ``contacts`` may return any.
        """
        ...

    def touching(self) -> bool:
        """Return quickly whether ``contacts`` may return any."""
        ...

    def contacts(self) -> list[BodyContact]:
        """Return the bodies that were in contact in the last step."""
        ...

    def set_collisions(self, a: int, b: int, enabled: bool) -> None:
        """State whether two bodies can touch each other."""
        ...

    def join(self, a: int, b: int, anchor_a_m: Array, anchor_b_m: Array, q_ab_wxyz: Array) -> None:
        """Join two bodies rigidly.

        ``anchor_*_m`` (3,): a point of each, in its frame, that the joint keeps together.
        ``q_ab_wxyz`` (4,): attitude of b relative to a.
        """
        ...

    def separate(self, a: int, b: int) -> None:
        """Remove the joint of two bodies."""
        ...

    def reaction(self, a: int, b: int) -> Sequence[float]:
        """Return what b exerted on a at their joint in the last step (6,).

        Force, N, in WRF; torque about the anchor, N m, in the axes that b had at the beginning of
        the step.
        """
        ...

    def close(self) -> None:
        """Free the engine."""
        ...
