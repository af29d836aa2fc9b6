# SPDX-License-Identifier: Apache-2.0
"""State of a flight that several checks need: bodies, phases, who commands whom."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import relative_acceleration, relative_torque
from chaserdock_protocol import topics
from chaserdock_protocol.leases import commander_of
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyTruth,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Event,
    MissionEnd,
    Reference,
    TargetEstimate,
    Tick,
    WorldTruth,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import RawSample
from chaserdock_world.orbit import TargetOrbit

from ..network import EPOCH_NS
from .causes import STOPPING_S, Causes
from .reader import MessageReader, reads


@dataclass(frozen=True)
class FreeStep:
    """True motion of a body in one tick in which nothing touched it.

    ``before``, ``after``: its states at successive ticks, ``dt_s`` apart. ``drawn``: its mass
    properties and disturbances, None if not published. ``orbit``: None in free space.
    """

    before: BodyTruth
    after: BodyTruth
    drawn: DrawnBody | None
    dt_s: float
    orbit: TargetOrbit | None

    @cached_property
    def halfway(self) -> Array:
        """Return the attitude (4,) in the middle of the tick, body to WRF."""
        q, omega = np.array(self.before.q_wxyz), np.array(self.before.omega_rad_s)
        return rotations.integrate(q, omega, 0.5 * self.dt_s)

    @property
    def turned_rad(self) -> float:
        """Return the angle (rad) by which the body turns in a tick at its final rate."""
        return math.hypot(*self.after.omega_rad_s) * self.dt_s

    @cached_property
    def orbital_impulse(self) -> tuple[Array, Array]:
        """Return the changes (3,) of momentum (N s) and angular momentum (N m s), WRF, that the
        orbit causes.
        """
        if self.orbit is None or self.drawn is None:
            return np.zeros(3), np.zeros(3)
        before, middle_s = self.before, (self.before.tick + 0.5) * self.dt_s
        frame = self.orbit.frame_at(middle_s)
        x, y, z = before.position_m
        acceleration = np.array(relative_acceleration(frame, (x, y, z), before.velocity_m_s))
        if before.body != "target":
            acceleration += self.orbit.differential_drag(middle_s)

        # The torque is known in principal axes.
        moments, axes = np.linalg.eigh(inertia_of(self.drawn))
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        q = rotations.multiply(np.array(before.q_wxyz), rotations.from_matrix(axes))
        a, b, c = (np.array(before.omega_rad_s) @ axes).tolist()
        ia, ib, ic = moments.tolist()
        torque = relative_torque(frame, q.tolist(), (a, b, c), (ia, ib, ic))
        return (
            self.drawn.mass_kg * acceleration * self.dt_s,
            rotations.rotate(q, torque) * self.dt_s,
        )


@dataclass
class FlightView(MessageReader):
    """A flight as its messages show it. ``FlightChecks`` updates it once per message, before the
    checks see that; checks only read it.

    Present message: ``sender``, ``key``, ``sent_ns``. ``published``: messages since the first tick,
    by key, as the recorder should have them. ``tick``: newest open tick. ``opens_tick``: the newest
    ``Tick`` did not repeat one.

    Bodies: ``state_tick``: newest tick whose true states are known. ``states``, ``drawn``: truth
    and mass properties of each. ``steps``: motion of those that nothing touched in the newest tick.
    ``touching``: those that touch another body or are latched to it. ``latched``: chasers whose
    latch is truly closed.

    Chasers: ``phases``: by their newest reference. ``sources``: what each flies, by its newest
    actuator command. ``commanders``: by tick, the controller whose command was flown first.
    ``lost``: processes that do not take part. ``unreachable``: processes that were lost, and
    chasers whose actuators were stopped, until they have flown commands for ``STOPPING_S``.
    """

    scenario: Scenario
    sender: str = ""
    key: str = ""
    sent_ns: int = EPOCH_NS
    published: Counter[str] = field(default_factory=Counter)
    tick: int = -1
    opens_tick: bool = False
    state_tick: int = -1
    states: dict[str, BodyTruth] = field(default_factory=dict)
    drawn: dict[str, DrawnBody] = field(default_factory=dict)
    steps: list[FreeStep] = field(default_factory=list)
    touching: set[str] = field(default_factory=set)
    latched: set[int] = field(default_factory=set)
    phases: dict[int, str] = field(default_factory=dict)
    sources: dict[int, str] = field(default_factory=dict)
    commanders: dict[int, str] = field(default_factory=dict)
    lost: set[str] = field(default_factory=set)
    unreachable: set[str] = field(default_factory=set)
    mission_end: MissionEnd | None = None
    _bodies: list[BodyTruth] = field(default_factory=list)
    _probing: set[str] = field(default_factory=set)
    _follows_since_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.causes = Causes(self.scenario)
        self.mismatch = self.scenario.truth.mismatch("chaser")
        orbit = self.scenario.orbit
        self.orbit = None if orbit is None else TargetOrbit(orbit)

    @property
    def time_s(self) -> float:
        """Mission time of the newest tick (s)."""
        return max(0, self.tick, self.state_tick) / self.scenario.time.rate_hz

    @property
    def ticks(self) -> int:
        """Number of ticks flown so far."""
        return 1 + max(self.tick, self.state_tick)

    @property
    def sent_s(self) -> float:
        """Virtual time (s) at which the present message was sent, whatever the sender's clock."""
        clocks = self.scenario.simulation.clock
        clock = next((c for c in clocks if c.process == self.sender), None)
        wall_s = (self.sent_ns - EPOCH_NS) * 1e-9
        return wall_s if clock is None else (wall_s - clock.offset_s) / (1.0 + clock.drift)

    def is_on_its_own(self, chaser: int) -> bool:
        """Return whether no command reaches a chaser: it is lost, stopped, or controls itself."""
        is_unreachable = f"chaser/{chaser}" in self.unreachable
        return is_unreachable or self.sources.get(chaser, "command") != "command"

    def truth_of(self, estimate: TargetEstimate) -> BodyTruth | None:
        """Return the true state of the target at the time of an estimate; None if either is
        unknown.
        """
        truth = self.states.get("target")
        if truth is None or not estimate.is_known:
            return None
        return truth if truth.sim_time_ns == estimate.sim_time_ns else None

    def receive(self, sender: str, raw: RawSample) -> None:
        """Record a message that has been published, before it is decoded."""
        self.sender, self.key, self.sent_ns = sender, raw.key, raw.sent_ns
        # The recorder listens from the first tick on. It does not record itself, and presence is
        # not required.
        if (self.published or raw.key == topics.TICK.key) and sender != "recorder":
            self.published[raw.key] += not raw.key.endswith("/presence")

    @reads(Tick)
    def _on_tick(self, tick: Tick) -> None:
        self.opens_tick = tick.tick > self.tick
        self.tick = max(self.tick, tick.tick)
        self.lost.difference_update(f"chaser/{i}" for i in tick.chasers)

    # -- bodies: the world publishes probes, then bodies, then its own state -----------------------

    @reads(DrawnTruth)
    def _on_drawn(self, drawn: DrawnTruth) -> None:
        self.drawn = {body.body: body for body in drawn.bodies}

    @reads(DockingStatus)
    def _on_docking(self, status: DockingStatus) -> None:
        if status.contact:  # also of a probe whose latch has just opened
            self._probing.add(f"chaser/{status.chaser}")

    @reads(BodyTruth)
    def _on_body(self, body: BodyTruth) -> None:
        self._bodies.append(body)

    @reads(WorldTruth)
    def _on_world(self, world: WorldTruth) -> None:
        self.state_tick = world.tick
        held = self.latched.union(world.latched)  # also until a release within this tick
        self.latched = set(world.latched)
        self.touching = {name for pair in world.contacts for name in pair}
        self.touching |= {f"chaser/{i}" for i in (*held, *(t.chaser for t in world.touches))}
        self.touching |= self._probing
        self._probing.clear()

        self.steps = []
        for body in self._bodies:
            before = self.states.get(body.body)
            self.states[body.body] = body
            touched = body.body in self.touching or (body.body == "target" and self.touching)
            if before is not None and not touched and body.tick == before.tick + 1:
                drawn, dt_s = self.drawn.get(body.body), 1.0 / self.scenario.time.rate_hz
                self.steps.append(FreeStep(before, body, drawn, dt_s, self.orbit))
        self._bodies.clear()

    # -- chasers -----------------------------------------------------------------------------------

    @reads(Reference)
    def _on_reference(self, reference: Reference) -> None:
        self.phases[reference.chaser] = reference.phase

    @reads(ActuatorCommand)
    def _on_command(self, command: ActuatorCommand) -> None:
        self.sources[command.chaser] = command.source
        if command.source == "command":
            self.commanders.setdefault(command.tick, commander_of(command.term))
        if f"chaser/{command.chaser}" in self.unreachable:
            self._note_return(command)

    def _note_return(self, command: ActuatorCommand) -> None:
        """Count a chaser as reachable again that has flown commands for ``STOPPING_S``, while no
        fault kept them from its actuators.
        """
        name, now_s = f"chaser/{command.chaser}", self.time_s
        if command.source != "command" or name in self.lost:
            self._follows_since_s.pop(name, None)
            return
        since_s = self._follows_since_s.setdefault(name, now_s)
        since_s = max(since_s, self.causes.keep_commands_until_s(name, now_s))
        if now_s - since_s > STOPPING_S:
            self.unreachable.remove(name)
            del self._follows_since_s[name]

    @reads(Event)
    def _on_event(self, event: Event) -> None:
        if (name := lost_by(event)) is not None:
            self.unreachable.add(name)
            self._follows_since_s.pop(name, None)
            if event.what == "process lost":
                self.lost.add(name)

    @reads(MissionEnd)
    def _on_end(self, end: MissionEnd) -> None:
        self.mission_end = end


def lost_by(event: Event) -> str | None:
    """Return the process that an event of the world reports as lost or whose actuators it reports
    as stopped; None for other events.
    """
    if event.process == "world" and event.what in ("process lost", "actuators stopped"):
        return event.detail.partition(":")[0]
    return None


def inertia_of(drawn: DrawnBody) -> Array:
    """Return the inertia (3, 3) of a body about its centre of mass, in its axes (kg m^2)."""
    return np.array(drawn.inertia_kg_m2).reshape(3, 3)
