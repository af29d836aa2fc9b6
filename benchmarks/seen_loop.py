"""A whole flight in one process, images and all: world physics, cameras, the chasers' perception, fusion, guidance and
NMPC, for figures of what is seen that need many flights. Everything is what flies; only the network is left out.

Beside the flight, ``shadows`` (fusion by other scenarios, with their perception) see the same images and steer nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import look, prediction_from
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Image, OperatorCommand, Sighting
from chaserdock_protocol.messages import TargetEstimate as Estimate
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import BodyState, Physics
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.sensors.errors import OdometrySensor
from chaserdock_world.sensors.publish import odometry_of

OnImage = Callable[[Image], Image | None]
"""What becomes of an image on its way to perception; None: it never comes."""
OnSighting = Callable[[Sighting], Sighting]
"""What a chaser reports instead of what it saw."""


@dataclass
class Estimates:
    """An estimator's errors against the truth, by tick (lists of K): position (m), angle (rad), the velocity's (m/s), the
    rate's (rad/s), NEES of the pose (6 degrees of freedom), the share of its six numbers inside 3 sigma, status."""

    time_s: list[float] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    angle_rad: list[float] = field(default_factory=list)
    velocity_m_s: list[float] = field(default_factory=list)
    omega_rad_s: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    status: list[str] = field(default_factory=list)

    def note(self, now_s: float, message: Estimate, truth: BodyState) -> None:
        """Takes down one estimate."""
        covariance = np.reshape(message.covariance, (12, 12))
        dp = truth.position_m - message.position_m
        dtheta = rotations.log(rotations.multiply(rotations.conjugate(message.q_wxyz), truth.q_wxyz))
        pose = np.concatenate([dp, dtheta])
        i = [0, 1, 2, 6, 7, 8]
        of_pose = covariance[np.ix_(i, i)]
        self.time_s.append(now_s)
        self.position_m.append(float(np.linalg.norm(dp)))
        self.angle_rad.append(float(np.linalg.norm(dtheta)))
        self.velocity_m_s.append(float(np.linalg.norm(truth.velocity_m_s - message.velocity_m_s)))
        self.omega_rad_s.append(float(np.linalg.norm(truth.omega_rad_s - message.omega_rad_s)))
        self.nees.append(float(pose @ np.linalg.solve(of_pose, pose)))
        self.inside.append(float(np.mean(np.abs(pose) <= 3.0 * np.sqrt(np.diag(of_pose)))))
        self.status.append(message.status)

    def array(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> Array:
        """One of the lists over a time."""
        t = np.array(self.time_s)
        return np.array(getattr(self, name))[(t >= from_s - 1e-9) & (t < to_s)]

    def largest(self, name: str, from_s: float) -> float:
        """The largest of one of the lists from then on, while there is an estimate at all."""
        known = self.array("status", from_s) != "none"
        return float(self.array(name, from_s)[known].max())

    def rms(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> float:
        """Root mean square of one of the lists over a time."""
        return float(np.sqrt(np.mean(np.square(self.array(name, from_s, to_s)))))


@dataclass
class Flown:
    """A flight: the fused ``estimates``, those of the shadows, tracking errors of the chasers (time s, m, rad) from their
    references on the true target, phases as (time, chaser, phase), events as (time, level, text), last messages."""

    estimates: Estimates
    shadows: dict[str, Estimates]
    tracking: dict[int, list[tuple[float, float, float]]]
    phases: list[tuple[float, int, str]]
    events: list[tuple[float, str, str]]
    seen: dict[int, list[bool]]
    last: TickOutputs
    reinitialisations: int

    def tracking_rms(self, from_s: float) -> tuple[float, float]:
        """RMS of position (m) and angle (rad) of all chasers from a time on."""
        rows = np.array([r[1:] for track in self.tracking.values() for r in track if r[0] >= from_s])
        m, rad = np.sqrt(np.mean(rows**2, axis=0)).tolist()
        return m, rad


class _Shadow:
    """Perception and fusion of another scenario on the same images."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.perceptions = [make_perception(scenario) for _ in scenario.chasers]
        self.flight = ControllerCore(scenario, time.perf_counter)
        self.estimates = Estimates()


def fly(
    scenario: Scenario,
    shadows: Mapping[str, Scenario] | None = None,
    on_image: OnImage | None = None,
    on_sighting: OnSighting | None = None,
    commands: Callable[[float], tuple[OperatorCommand, ...]] = lambda now_s: (),
    until: Callable[[float, Estimates], bool] = lambda now_s, estimates: False,
) -> Flown:
    """Flies a scenario to its end, or until ``until`` says so."""
    physics, timing, cameras = Physics(scenario), scenario.timing, Cameras(scenario)
    navigation, numbers = OdometrySensor(scenario), range(len(scenario.chasers))
    actuators = {f"chaser/{i}": make_actuators(scenario, i) for i in numbers}
    perceptions = [make_perception(scenario) for _ in numbers]
    flight = ControllerCore(scenario, time.perf_counter)
    beside = {name: _Shadow(s) for name, s in (shadows or {}).items()}
    before: dict[int, Sighting] = {}
    estimates = Estimates()
    tracking: dict[int, list[tuple[float, float, float]]] = {i: [] for i in numbers}
    seen: dict[int, list[bool]] = {i: [] for i in numbers}
    phases: list[tuple[float, int, str]] = []
    events: list[tuple[float, str, str]] = []
    out: TickOutputs | None = None
    try:
        for tick in range(scenario.ticks):
            now_ns = timing.tick_time_ns(tick)
            now_s = now_ns / 1e9
            states = {name: physics.state(name) for name in physics.bodies}
            odometry = {
                i: odometry_of(i, navigation.measure(i, tick, states[f"chaser/{i}"]), tick, now_ns)
                for i in numbers
            }
            sightings: list[Sighting] = []
            aside: dict[str, list[Sighting]] = {name: [] for name in beside}
            for i in numbers if timing.has_images(tick) else ():
                image = cameras.image(i, tick // timing.ticks_per_image, tick, now_ns, states)
                given = image if on_image is None else on_image(image)
                if given is None:
                    blind = msgspec.structs.replace(
                        image, encoding="mono8", data=bytes(image.width_px * image.height_px)
                    )
                    given = blind
                before[i] = look(perceptions[i], given, prediction_from(before.get(i)))
                seen[i].append(bool(before[i].solutions))
                sightings.append(before[i] if on_sighting is None else on_sighting(before[i]))
                for name, shadow in beside.items():
                    same = shadow.scenario.perception.name == scenario.perception.name
                    sighting = before[i] if same else look(shadow.perceptions[i], given, None)
                    aside[name].append(sighting if on_sighting is None else on_sighting(sighting))
            out = flight.step(TickInputs(tick, now_ns, odometry, tuple(sightings), commands(now_s)))
            truth = states["target"]
            estimates.note(now_s, out.target, truth)
            for name, shadow in beside.items():
                fused = shadow.flight.estimate(TickInputs(tick, now_ns, odometry, tuple(aside[name])))
                shadow.estimates.note(now_s, fused, truth)
            events += [(now_s, e.level, e.what) for e in out.events]
            for i, r in out.references.items():
                tracking[i].append(
                    (now_s, *_off(r.position_m, r.q_wxyz, out.target, truth, states[f"chaser/{i}"]))
                )
                if (
                    not any(p[1] == i for p in phases)
                    or next(p for p in reversed(phases) if p[1] == i)[2] != r.phase
                ):
                    phases.append((now_s, i, r.phase))
            for i, command in out.wrenches.items():
                given = passed_on(command)
                effective = timing.step_of_time(given.effective_time_ns)
                actuators[f"chaser/{i}"].command(given, effective, physics.step_count)
            fly_to(timing.step_of_tick(tick + 1), physics, actuators, 1.0 / timing.physics_hz)
            if until(now_s, estimates):
                break
    finally:
        physics.close()
    assert out is not None
    return Flown(
        estimates,
        {name: shadow.estimates for name, shadow in beside.items()},
        tracking,
        phases,
        events,
        seen,
        out,
        flight.estimator.reinitialisations,
    )


def _off(
    position_m: tuple[float, ...],
    q_wxyz: tuple[float, ...],
    fused: Estimate,
    truth: BodyState,
    own: BodyState,
) -> tuple[float, float]:
    """Distance (m) and angle (rad) of a chaser from its reference pose (WRF, on the fused target), put on the true one."""
    offset = rotations.rotate_inverse(fused.q_wxyz, np.array(position_m) - fused.position_m)
    q_off = rotations.multiply(rotations.conjugate(fused.q_wxyz), q_wxyz)
    place = truth.position_m + rotations.rotate(truth.q_wxyz, offset)
    attitude = rotations.multiply(truth.q_wxyz, q_off)
    return float(np.linalg.norm(place - own.position_m)), float(rotations.angle_between(attitude, own.q_wxyz))


def changed(scenario: Scenario, **sections: object) -> Scenario:
    """A scenario with some of its fields replaced, checked again. Sections as dictionaries are merged into what is there."""
    values = scenario.model_dump()
    for name, value in sections.items():
        values[name] = (
            values[name] | value if isinstance(value, dict) and isinstance(values[name], dict) else value
        )
    return Scenario.model_validate(values)


__all__ = ["Estimates", "Flown", "changed", "fly", "replace"]
