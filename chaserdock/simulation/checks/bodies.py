# SPDX-License-Identifier: Apache-2.0
"""Invariants of the true motion of bodies: distances, and laws of mechanics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from chaserdock_controller.guidance.approach_cone import cone_of
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, length
from chaserdock_models.plane import UP, flattened, lean_rad
from chaserdock_protocol.messages import BodyTruth, DrawnBody, Tick, WorldTruth
from chaserdock_protocol.scenario.planar import up_in_target

from chaserdock.analysis.criteria import nearest_allowed_m

from .causes import DEVICES_SETTLE_S, IN_LATE_NETWORK, SETTLING_S, STOPPING_S
from .check import Check
from .flight_view import FlightView, FreeStep, inertia_of
from .reader import reads

KEEP_OUT_SLACK_M = 0.02
"""Distance (m) by which errors of its estimate may bring a chaser into a keep-out zone. Larger:
real violations pass; smaller: accurate flights fail.
"""

POSE_ROUNDING = 1e-6
"""Largest rounding error of a pose (m, rad), by the engine's 64-bit and by message numbers."""

DISPLACEMENT_FLOOR_M = 2e-5
"""Displacement (m) in a tick that velocities need not explain: above rounding. Larger: small jumps
pass.
"""

IMPULSE_SHARE = 0.02
"""Share of the impulses in a tick by which momentum may differ from them. Forces act at the
attitudes of the engine's steps; the check uses the one in the middle of the tick. Larger: wrong
forces pass; smaller: fast turns fail.
"""
IMPULSE_FLOOR_N_S, ANGULAR_FLOOR_N_M_S = 2e-5, 2e-5
"""Momentum (N s) and angular momentum (N m s) in a tick that need no cause: above rounding, below
the shortest pulse.
"""
ARM_M = 0.1
"""Lever arm (m) of thrusters, the order of a chaser's size. It converts impulses to angular
ones.
"""
NOISE_SIGMAS = 5.0
"""Standard deviations of the world's random force in a tick. Normal errors exceed them once in 2
million ticks.
"""

OFF_FLOOR = 1e-6
"""Motion of a body on a floor out of its plane (m, m/s, rad, rad/s) that counts as rounding."""

CONSERVED_SHARE = 2e-3
"""Largest drift of what the untouched target conserves, as a share of its initial value. Larger:
wrong dynamics pass; smaller: the engine's integration errors fail long flights.
"""
SPUN_SHARE = 1e-5
"""Largest unexplained change of angular momentum in a tick in an orbit, as a share of it. The
turning frame alone gives 7e-5.
"""

DETUMBLING = frozenset({"identify", "detumble", "stack_hold"})
"""Phases in which latched chasers stop the target, or keep it at rest."""
TUMBLE_SHARE, TUMBLE_FLOOR_N_M_S = 0.05, 0.02
"""Rise of a stack's angular momentum above its least value while it is being stopped: share of its
initial value, plus a floor (N m s). Larger: spinning up passes; smaller: pulses that identify the
stack fail.
"""

WHILE_MISLED = (
    f"the target, while the sensors of half of the chasers lie, and {SETTLING_S:g} s after it: "
    "nobody can know then which are honest"
)


@dataclass
class NoContact(Check):
    """Only probe and port touch."""

    name = "no contact"
    exceptions = (
        "what a chaser hits that no command reaches: one whose process is lost or whose actuators "
        f"were stopped, until it has flown commands for {STOPPING_S:g} s",
        WHILE_MISLED,
    )

    @reads(WorldTruth)
    def judge(self, world: WorldTruth) -> None:
        view = self.view
        for a, b in world.contacts:
            drifts = {a, b} & view.unreachable
            if not drifts and not ("target" in (a, b) and view.causes.misleads(view.time_s)):
                self.violate(f"{a} and {b}", "bodies touch")


def pairs_nearer_than(
    distance_m: float, places: Sequence[Sequence[float]]
) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of places (3,) that are nearer to each other, in order.

    Only places that are neighbours along the first axis are compared.
    """
    found, order = [], sorted(range(len(places)), key=lambda i: places[i][0])
    for k, i in enumerate(order):
        for j in order[k + 1 :]:
            if places[j][0] - places[i][0] >= distance_m:
                break
            if math.dist(places[i], places[j]) < distance_m:
                found.append((min(i, j), max(i, j)))
    return sorted(found)


@dataclass
class KeepOutZone(Check):
    """Distances between chasers and from the target stay above those of `[limits]` less
    ``KEEP_OUT_SLACK_M``; in the corridor of its port (`docking.corridor_angle_deg`), widened by
    as much, a chaser may come as near to the target as it docks.
    """

    name = "keep-out zone"
    exceptions = (
        "a chaser that no command reaches",
        "a chaser with a port that controls itself without a controller, as the corridor rotates "
        "with the target: as in the corridor",
        WHILE_MISLED,
        "the target, for a chaser whose probe touches it",
    )

    def begin(self) -> None:
        s = self.scenario
        chasers = range(len(s.chasers))
        self._nearest_m = {f"chaser/{i}": nearest_allowed_m(s, i) for i in chasers}
        self._cones = {f"chaser/{p.chaser}": cone_of(s, p.chaser) for p in s.docking.ports}

    @reads(Tick)
    def judge(self, tick: Tick) -> None:
        view, target = self.view, self.view.states.get("target")
        if not view.opens_tick:
            return
        chasers = {
            name: state.position_m
            for name, state in view.states.items()
            if name != "target" and name not in view.unreachable
        }

        limit_m = self.scenario.limits.min_distance_chasers_m - KEEP_OUT_SLACK_M
        names, places = list(chasers), list(chasers.values())
        for a, b in pairs_nearer_than(limit_m, places):
            distance_m = math.dist(places[a], places[b])
            self.violate(f"{names[a]} and {names[b]}", f"{distance_m:.3f} m apart")

        if target is None or view.causes.misleads(view.time_s):
            return
        for name, at in chasers.items():
            if name in view.touching:
                continue
            offset = rotations.rotate_inverse(target.q_wxyz, np.subtract(at, target.position_m))
            distance_m = length(offset)
            if distance_m < self._nearest_allowed_m(name, offset) - KEEP_OUT_SLACK_M:
                self.violate(name, f"{distance_m:.3f} m from the target")

    def _nearest_allowed_m(self, name: str, offset_m: Array) -> float:
        """Return the smallest allowed distance from the target of a chaser at an offset (3,),
        TRF.
        """
        if self.scenario.chooses_port(int(name.partition("/")[2])):
            return self._nearest_m[name]  # the scenario does not know its corridor
        cone = self._cones.get(name)
        if cone is not None and (
            cone.room_m(offset_m) > -KEEP_OUT_SLACK_M
            or self.view.is_on_its_own(int(name.partition("/")[2]))
        ):
            return self._nearest_m[name]
        return self.scenario.limits.min_distance_target_m


@dataclass
class InitialState(Check):
    """All bodies begin at their poses in the scenario."""

    name = "initial state"

    @reads(WorldTruth)
    def judge(self, world: WorldTruth) -> None:
        if world.tick != 0:
            return
        for name, body in self.view.states.items():
            if name in self.view.touching or (name == "target" and self.view.touching):
                continue
            position, q = self._start_pose(name)
            error_m = math.dist(position, body.position_m)
            error_rad = float(rotations.angle_between(q, np.array(body.q_wxyz)))
            if max(error_m, error_rad) > POSE_ROUNDING:
                error = f"{error_m:.2e} m and {error_rad:.2e} rad"
                self.violate(name, f"begins {error} from its pose in the scenario")

    def _start_pose(self, name: str) -> tuple[Array, Array]:
        target = self.scenario.target
        if name == "target":
            return np.array(target.position_m), np.array(target.q_wxyz)
        return self.scenario.start_pose(int(name.partition("/")[2]))


@dataclass
class Displacement(Check):
    """Bodies move as far as their velocities say; a force that changes within a tick adds less
    than the velocity that it gives, times the tick."""

    name = "displacement"
    exceptions = ("a body that touches another one",)

    @reads(FreeStep)
    def judge(self, step: FreeStep) -> None:
        before, after, dt_s = step.before, step.after, step.dt_s
        mean = np.add(before.velocity_m_s, after.velocity_m_s) / 2.0
        expected_m = np.array(before.position_m) + mean * dt_s
        error_m = math.dist(after.position_m, expected_m.tolist())

        # The origin of a body turns about its centre of mass.
        gained_m_s = math.dist(before.velocity_m_s, after.velocity_m_s)
        pushed_m_s, off_m = 0.0, 0.0
        if step.drawn is not None:
            pushed_m_s = after.absolute_impulse_N_s / step.drawn.mass_kg
            off_m = math.hypot(*step.drawn.centre_of_mass_m)
        turned_rad = (math.hypot(*after.omega_rad_s) + math.hypot(*before.omega_rad_s)) * dt_s
        allowed_m = DISPLACEMENT_FLOOR_M + (gained_m_s + pushed_m_s) * dt_s + off_m * turned_rad
        if error_m > allowed_m:
            text = f"moved {error_m:.2e} m more than its velocity explains, {allowed_m:.2e} allowed"
            self.violate(after.body, text)


class _OfChasers:
    """Exceptions that both momentum checks share."""

    exceptions = (
        "a chaser that touches another body",
        "a chaser among several, where plumes push (`[plume]`)",
        "a body whose origin is not its centre of mass",
    )


def _judged(step: FreeStep, view: FlightView) -> DrawnBody | None:
    """Return the mass properties of a chaser if its actuators, disturbances and orbit explain how
    its momentum changes; None for other bodies.
    """
    if step.after.body == "target" or step.drawn is None or any(step.drawn.centre_of_mass_m):
        return None
    is_pushed = view.scenario.plume is not None and len(view.scenario.chasers) > 1
    return None if is_pushed else step.drawn


@dataclass
class LinearMomentum(_OfChasers, Check):
    """The momentum of a chaser changes by the impulses of its actuators, disturbances and orbit."""

    name = "momentum"

    @reads(FreeStep)
    def judge(self, step: FreeStep) -> None:
        if (drawn := _judged(step, self.view)) is None:
            return
        before, after, dt_s = step.before, step.after, step.dt_s
        impulse = np.array(after.impulse_N_s) + np.array(drawn.force_N) * dt_s
        velocities = np.array(after.velocity_m_s) - np.array(before.velocity_m_s)
        gained = drawn.mass_kg * velocities - step.orbital_impulse[0]
        error = gained - rotations.rotate(step.halfway, impulse)
        error = length(flattened(error, UP) if self.scenario.chaser.is_planar else error)
        allowed = IMPULSE_FLOOR_N_S + (IMPULSE_SHARE + step.turned_rad) * (
            after.absolute_impulse_N_s + math.hypot(*drawn.force_N) * dt_s
        )
        if error > allowed + NOISE_SIGMAS * self.view.mismatch.force_noise_N * dt_s:
            self.violate(after.body, f"{error:.2e} N s without a cause, {allowed:.2e} allowed")


@dataclass
class AngularMomentum(_OfChasers, Check):
    """The angular momentum of a chaser changes by the angular impulses of its actuators,
    disturbances and orbit."""

    name = "angular momentum"

    @reads(FreeStep)
    def judge(self, step: FreeStep) -> None:
        if (drawn := _judged(step, self.view)) is None:
            return
        before, after, dt_s = step.before, step.after, step.dt_s
        inertia = inertia_of(drawn)
        angular = np.array(after.angular_impulse_N_m_s) + np.array(drawn.torque_N_m) * dt_s
        spun = rotations.rotate(after.q_wxyz, inertia @ after.omega_rad_s)
        spun = spun - rotations.rotate(before.q_wxyz, inertia @ before.omega_rad_s)
        spun = spun - step.orbital_impulse[1]
        error = spun - rotations.rotate(step.halfway, angular)
        error = length(error * UP if self.scenario.chaser.is_planar else error)
        allowed = ANGULAR_FLOOR_N_M_S + (IMPULSE_SHARE + step.turned_rad) * (
            float(np.abs(angular).sum()) + ARM_M * after.absolute_impulse_N_s
        )
        if error > allowed + NOISE_SIGMAS * self.view.mismatch.torque_noise_N_m * dt_s:
            self.violate(after.body, f"{error:.2e} N m s without a cause, {allowed:.2e} allowed")


@dataclass
class OnFloor(Check):
    """Bodies on a floor (`chaser.degrees_of_freedom = "planar"`) stay at their height, to
    ``OFF_FLOOR``, do not lean, and turn about the vertical only."""

    name = "on the floor"

    _heights_m: dict[str, float] = field(default_factory=dict)

    def begin(self) -> None:
        self._up = up_in_target(self.scenario)

    @reads(BodyTruth)
    def judge(self, body: BodyTruth) -> None:
        if self._up is None:
            return
        height_m = self._heights_m.setdefault(body.body, body.position_m[2])
        up = self._up if body.body == "target" else UP
        off = {
            "m off its height": abs(body.position_m[2] - height_m),
            "m/s up or down": abs(body.velocity_m_s[2]),
            "rad of lean": lean_rad(body.q_wxyz, up),
            "rad/s about horizontal axes": length(flattened(body.omega_rad_s, up)),
        }
        for name, value in off.items():
            if value > OFF_FLOOR:
                self.violate(body.body, f"{value:.2e} {name}")


@dataclass
class TargetMotion(Check):
    """The untouched target keeps its rotational energy, speed and, if it is torque-free, its
    angular momentum; in an orbit that changes by what the orbit gives."""

    name = "energy and momentum"
    exceptions = (
        "while a body touches another one",
        "where plumes push (`[plume]`)",
        "its speed, where its origin is not its centre of mass",
    )

    _first: dict[str, float] = field(default_factory=dict)
    """Conserved quantities when the target was last touched."""

    @reads(WorldTruth)
    def begin_again(self, world: WorldTruth) -> None:
        if self.view.touching:
            self._first.clear()

    @reads(FreeStep)
    def judge(self, step: FreeStep) -> None:
        if step.after.body != "target" or step.drawn is None or self.scenario.plume is not None:
            return
        if self.view.orbit is not None and self.scenario.target.motion == "torque_free":
            self._judge_in_orbit(step, step.drawn)
            return
        scale = length(inertia_of(step.drawn) @ np.array(step.after.omega_rad_s))
        for name, value in self._conserved(step.after, step.drawn).items():
            first = self._first.setdefault(name, value)
            size = max(abs(first), scale if name.startswith("angular") else abs(first), 1e-9)
            if abs(value - first) > CONSERVED_SHARE * size:
                self.violate("target", f"{name} from {first:.6g} to {value:.6g}")

    def _conserved(self, body: BodyTruth, drawn: DrawnBody) -> dict[str, float]:
        """Return the quantities that the target's kind of motion conserves, by name."""
        omega, inertia = np.array(body.omega_rad_s), inertia_of(drawn)
        conserved = {"rotational energy": 0.5 * float(omega @ inertia @ omega)}
        if not any(drawn.centre_of_mass_m):
            conserved["speed"] = length(np.array(body.velocity_m_s))
        if self.scenario.target.motion == "torque_free":
            momentum = rotations.rotate(np.array(body.q_wxyz), inertia @ omega)
            axes = list(zip("xyz", momentum.tolist(), strict=True))
            axes = axes[2:] if self.scenario.chaser.is_planar else axes
            conserved |= {f"angular momentum {axis}": x for axis, x in axes}
        return conserved

    def _judge_in_orbit(self, step: FreeStep, drawn: DrawnBody) -> None:
        inertia = inertia_of(drawn)
        states = step.before, step.after
        spun = [rotations.rotate(s.q_wxyz, inertia @ s.omega_rad_s) for s in states]
        error = length(spun[1] - spun[0] - step.orbital_impulse[1])
        allowed = SPUN_SHARE * length(spun[1]) + 1e-12
        if error > allowed:
            text = f"target: {error:.2e} N m s without a cause, {allowed:.2e} allowed"
            self.violate("target", text)


@dataclass
class TumbleFalls(Check):
    """While latched chasers stop the target (`identify`, `detumble`, `stack_hold`), the angular
    momentum of the stack about its centre of mass rises above its least by at most
    ``TUMBLE_SHARE`` of its first value and ``TUMBLE_FLOOR_N_M_S``."""

    name = "tumble falls"
    exceptions = (
        "with thruster failures",
        f"during faults, and {DEVICES_SETTLE_S:g} s after them",
        IN_LATE_NETWORK,
    )

    _first_N_m_s: float | None = None
    _least_N_m_s: float = math.inf

    @reads(WorldTruth)
    def judge(self, world: WorldTruth) -> None:
        view = self.view
        names = ["target", *(f"chaser/{i}" for i in sorted(view.latched))]
        stopping = any(view.phases.get(i) in DETUMBLING for i in view.latched)
        known = view.states.keys() & view.drawn.keys()
        is_judged = stopping and known.issuperset(names)
        if not is_judged or view.causes.disturbs_thrusters(view.time_s):
            self._first_N_m_s, self._least_N_m_s = None, math.inf
            return
        bodies = [(view.states[name], view.drawn[name]) for name in names]
        now = float(np.linalg.norm(angular_momentum(bodies)))
        if self._first_N_m_s is None:
            self._first_N_m_s = now
        least = self._least_N_m_s
        self._least_N_m_s = min(least, now)
        if now > least + TUMBLE_SHARE * self._first_N_m_s + TUMBLE_FLOOR_N_M_S:
            text = f"the angular momentum of the stack rises from {least:.3g} to {now:.3g} N m s"
            self.violate("target", text)


def angular_momentum(bodies: Sequence[tuple[BodyTruth, DrawnBody]]) -> Array:
    """Return the angular momentum (3,), WRF, N m s, of bodies about their common centre of mass."""
    mass = np.array([drawn.mass_kg for _, drawn in bodies])
    spin = np.zeros(3)
    at, velocity = np.zeros((len(bodies), 3)), np.zeros((len(bodies), 3))
    for k, (body, drawn) in enumerate(bodies):
        q, omega = np.array(body.q_wxyz), np.array(body.omega_rad_s)
        arm = rotations.rotate(q, np.array(drawn.centre_of_mass_m))
        at[k] = np.array(body.position_m) + arm
        velocity[k] = np.array(body.velocity_m_s) + np.cross(rotations.rotate(q, omega), arm)
        spin += rotations.rotate(q, inertia_of(drawn) @ omega)
    about = at - mass @ at / mass.sum()
    return spin + (mass[:, None] * np.cross(about, velocity)).sum(axis=0)
