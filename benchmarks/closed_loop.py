"""A whole mission in one process, without images: world physics, thrusters, chasers' pilots and controller, for figures
that need many flights. The target is seen exactly, or with Gaussian noise; everything else is what flies."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from chaserdock_agents.chaser.command_gate import passed_on
from chaserdock_agents.chaser.thrusters.controller import ThrusterController
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import TickInputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ActuatorCommand, Odometry, PoseSolution, Sighting, ThrusterReport
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import BodyState, Physics

_SIGMA_M, _SIGMA_RAD = 1e-4, 1e-4


@dataclass
class Record:
    """One chaser's flight by tick: time (K,) s, errors (K,) m and rad from its reference on the true target; what its
    thrusters gave, (K, n) N s; totals; commands; what was told, as (time, text)."""

    time_s: list[float] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    angle_rad: list[float] = field(default_factory=list)
    thrusters_N_s: list[tuple[float, ...]] = field(default_factory=list)
    absolute_impulse_N_s: float = 0.0
    propellant_kg: float = 0.0
    commands: list[ActuatorCommand] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)

    def rms(self, from_s: float, to_s: float = np.inf) -> tuple[float, float]:
        """RMS errors, m and rad, over a time."""
        t = np.array(self.time_s)
        span = (t >= from_s) & (t < to_s)
        return tuple(
            float(np.sqrt(np.mean(np.square(np.array(x)[span])))) for x in (self.position_m, self.angle_rad)
        )  # type: ignore[return-value]

    def thruster_impulse_N_s(self) -> float:
        """What all thrusters gave together."""
        return float(np.sum(self.thrusters_N_s)) if self.thrusters_N_s else 0.0


def fly(
    scenario: Scenario,
    seed: int = 0,
    noise_m: float = 0.0,
    noise_rad: float = 0.0,
    on_tick: Callable | None = None,
) -> dict[int, Record]:
    """Flies a scenario to its end; records by chaser. ``noise_*``: one sigma of every sighting, each axis."""
    rng = np.random.default_rng(seed)
    physics, timing = Physics(scenario), scenario.timing
    numbers = range(len(scenario.chasers))
    actuators = {f"chaser/{i}": make_actuators(scenario, i) for i in numbers}
    thrusters = scenario.chaser.actuation == "thrusters"
    pilots = {i: ThrusterController(scenario, i) for i in numbers} if thrusters else {}
    flight = ControllerCore(scenario, time.perf_counter)
    records = {i: Record() for i in numbers}
    offsets = {i: scenario.chasers[i].position_m for i in numbers}
    try:
        for tick in range(scenario.ticks):
            now_ns, step = timing.tick_time_ns(tick), timing.step_of_tick(tick)
            target = physics.state("target")
            odometry: dict[int, Odometry] = {}
            reports: dict[int, ThrusterReport] = {}
            sightings = []
            for i in numbers:
                state = physics.state(f"chaser/{i}")
                odometry[i] = _odometry(state, i, tick, now_ns)
                took = actuators[f"chaser/{i}"].take_output(step)
                records[i].absolute_impulse_N_s += took.absolute_impulse_N_s
                records[i].propellant_kg += took.propellant_kg
                records[i].thrusters_N_s.append(took.thruster_impulse_N_s)
                if i in pilots:
                    reports[i] = pilots[i].observe(odometry[i])
                    told = pilots[i].drain_events()
                    records[i].events += [(now_ns / 1e9, f"{what}: {detail}") for _, what, detail in told]
                if timing.has_images(tick):
                    noise = rng.normal(size=6) * ([noise_m] * 3 + [noise_rad] * 3)
                    sightings.append(
                        _sighting(scenario, i, tick, now_ns, state, target, noise, noise_m, noise_rad)
                    )
            out = flight.step(TickInputs(tick, now_ns, odometry, tuple(sightings), thrusters=reports))
            for i, command in out.wrenches.items():
                if i in out.references:
                    offsets[i] = out.references[i].offset_m
                given = passed_on(command)
                if i in pilots:
                    pilots[i].apply_command(command)
                    given = pilots[i].add_pulses(given)
                effective = timing.step_of_time(given.effective_time_ns)
                actuators[f"chaser/{i}"].command(given, effective, physics.step_count)
                _note(records[i], given, target, offsets[i], scenario.chasers[i].q_wxyz, odometry[i])
            if on_tick is not None:
                on_tick(tick, physics)
            fly_to(timing.step_of_tick(tick + 1), physics, actuators, 1.0 / timing.physics_hz)
    finally:
        physics.close()
    return records


def _odometry(state: BodyState, chaser: int, tick: int, now_ns: int) -> Odometry:
    return Odometry(
        tick=tick,
        sim_time_ns=now_ns,
        chaser=chaser,
        position_m=vector(state.position_m),
        velocity_m_s=vector(state.velocity_m_s),
        q_wxyz=vector(state.q_wxyz),
        omega_rad_s=vector(state.omega_rad_s),
    )


def _sighting(
    scenario: Scenario,
    chaser: int,
    tick: int,
    now_ns: int,
    own: BodyState,
    target: BodyState,
    noise: Array,
    sigma_m: float,
    sigma_rad: float,
) -> Sighting:
    """What a camera sees of the target's true pose, with ``noise`` (6,) on it."""
    camera = scenario.camera_model()
    to_camera = rotations.multiply(own.q_wxyz, camera.q_crf_irf_wxyz)
    place = own.position_m + rotations.rotate(own.q_wxyz, camera.position_crf_m)
    q = rotations.multiply(rotations.conjugate(to_camera), target.q_wxyz)
    sigma = np.array([max(sigma_m, _SIGMA_M)] * 3 + [max(sigma_rad, _SIGMA_RAD)] * 3)
    solution = PoseSolution(
        position_m=vector(rotations.rotate_inverse(to_camera, target.position_m - place) + noise[:3]),
        q_wxyz=vector(rotations.normalize(rotations.multiply(q, rotations.exp(noise[3:])))),
        covariance=vector(np.diag(sigma**2)),
        reprojection_rms_px=0.1,
    )
    return Sighting(
        tick=tick,
        sim_time_ns=now_ns,
        chaser=chaser,
        status="seen",
        solutions=(solution,),
        marker_ids=(0, 1),
        corners_px=(),
        rejected_ids=(),
    )


def _note(
    record: Record,
    command: ActuatorCommand,
    target: BodyState,
    offset_m: tuple[float, float, float],
    q_off: tuple[float, ...],
    own: Odometry,
) -> None:
    place = target.position_m + rotations.rotate(target.q_wxyz, np.array(offset_m))
    attitude = rotations.multiply(target.q_wxyz, np.array(q_off))
    record.time_s.append(own.sim_time_ns / 1e9)
    record.position_m.append(float(np.linalg.norm(place - own.position_m)))
    record.angle_rad.append(float(rotations.angle_between(attitude, np.array(own.q_wxyz))))
    record.commands.append(command)
