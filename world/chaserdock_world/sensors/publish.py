# SPDX-License-Identifier: Apache-2.0
"""Publish the world's messages at the beginning of a tick: odometry, docking sensors,
ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from chaserdock_models.clock import Timing
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    BodyTruth,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Odometry,
    PlumeLoad,
    PortLoad,
    WorldTruth,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node

from chaserdock_world.actuators.ideal import Actuators
from chaserdock_world.physics.latch import ProbeLatch
from chaserdock_world.physics.port_loads import IntervalLoads
from chaserdock_world.physics.simulation import BodyState, Physics
from chaserdock_world.plant import Plant, actuation_errors, chaser_plant, target_plant, true_target

from .errors import OdometrySensor, camera_errors


def odometry_of(
    sensor: OdometrySensor, chaser: int, true_state: BodyState, tick: int, time_ns: int
) -> Odometry:
    """Return a chaser's odometry message, as ``sensor`` measures its state."""
    covariances: dict[str, Any] = sensor.covariances
    measured = _state_fields(sensor.measure(chaser, tick, true_state))
    return Odometry(tick=tick, sim_time_ns=time_ns, chaser=chaser, **measured, **covariances)


def publish_odometry(
    node: Node, states: dict[str, BodyState], tick: int, timing: Timing, sensor: OdometrySensor
) -> None:
    """Publish every chaser's measured state."""
    for name, state in states.items():
        if not name.startswith("chaser/"):
            continue
        chaser = int(name.partition("/")[2])
        message = odometry_of(sensor, chaser, state, tick, timing.tick_time_ns(tick))
        node.publish(topics.ODOMETRY, message, chaser)


def docking_status(latch: ProbeLatch, tick: int, time_ns: int) -> DockingStatus:
    """Return the message of a chaser's docking sensor for the time since the last tick."""
    return DockingStatus(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=latch.chaser,
        contact=latch.touched,
        armed=latch.armed,
        latched=latch.latched,
    )


def publish_docking(node: Node, latches: dict[str, ProbeLatch], tick: int, timing: Timing) -> None:
    """Publish the docking sensors of the chasers that have a port."""
    for latch in latches.values():
        node.publish(
            topics.DOCKING, docking_status(latch, tick, timing.tick_time_ns(tick)), latch.chaser
        )


def publish_truth(
    node: Node,
    states: dict[str, BodyState],
    tick: int,
    timing: Timing,
    actuators: Mapping[str, Actuators],
    contacts: set[tuple[str, str]],
    latches: dict[str, ProbeLatch],
) -> None:
    """Publish the ground truth of all bodies.

    Takes, and so resets, actuator outputs and touches since the last tick.
    """
    time_ns = timing.tick_time_ns(tick)
    saturated, late = [], 0
    for name, state in states.items():
        output: dict[str, Any] = {}
        if name in actuators:
            taken = actuators[name].take_output(timing.step_of_tick(tick))
            output = {
                "impulse_N_s": vector(taken.impulse[:3]),
                "angular_impulse_N_m_s": vector(taken.impulse[3:]),
                "absolute_impulse_N_s": taken.absolute_impulse_N_s,
                "thruster_impulse_N_s": taken.thruster_impulse_N_s,
                "thruster_open_s": taken.thruster_open_s,
                "propellant_kg": taken.propellant_kg,
            }
            late += taken.late
            if taken.saturated:
                saturated.append(int(name.partition("/")[2]))

        message = BodyTruth(
            tick=tick, sim_time_ns=time_ns, body=name, **_state_fields(state), **output
        )
        node.publish(topics.TRUTH_BODY, message, name)

    world = WorldTruth(
        tick=tick,
        sim_time_ns=time_ns,
        contacts=tuple(sorted(contacts)),
        saturated=tuple(saturated),
        late_commands=late,
        latched=tuple(latch.chaser for latch in latches.values() if latch.latched),
        touches=tuple(touch for latch in latches.values() for touch in latch.take_touches()),
    )
    node.publish(topics.TRUTH_WORLD, world)


def publish_port_loads(node: Node, physics: Physics, tick: int, timing: Timing) -> None:
    """Publish the loads at all ports since the last tick, which this takes."""
    for name, recorder in physics.port_loads.items():
        chaser = physics.latches[name].chaser
        message = port_load(recorder.take(), chaser, tick, timing.tick_time_ns(tick))
        node.publish(topics.TRUTH_LOAD, message, chaser)


def publish_plume_loads(node: Node, physics: Physics, tick: int, timing: Timing) -> None:
    """Publish what plumes gave every body since the last tick, which this takes."""
    if physics.plumes is None:
        return
    for name in physics.plumes.bodies:
        taken = physics.plumes.take(name)
        message = PlumeLoad(
            tick=tick,
            sim_time_ns=timing.tick_time_ns(tick),
            body=name,
            impulse_N_s=vector(taken.impulse[:3]),
            angular_impulse_N_m_s=vector(taken.impulse[3:]),
            peak_force_N=taken.peak_force_N,
        )
        node.publish(topics.TRUTH_PLUME, message, name)


def port_load(loads: IntervalLoads, chaser: int, tick: int, time_ns: int) -> PortLoad:
    """Return the message of the loads at a chaser's port."""
    return PortLoad(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=chaser,
        force_N=vector(loads.force_N),
        torque_N_m=vector(loads.torque_N_m),
        peak_force_N=loads.peak_force_N,
        peak_torque_N_m=loads.peak_torque_N_m,
        peak_axial_N=loads.peak_axial_N,
        peak_shear_N=loads.peak_shear_N,
        peak_bending_N_m=loads.peak_bending_N_m,
        closing_impulse_N_s=loads.closing_impulse_N_s,
    )


def drawn_truth(scenario: Scenario, sensor: OdometrySensor) -> DrawnTruth:
    """Return everything that was drawn once for this mission."""
    chasers = tuple(_drawn_chaser(scenario, sensor, i) for i in range(len(scenario.chasers)))
    pairs = zip(scenario.target_model().markers, true_target(scenario).markers, strict=True)
    shifts = tuple(
        b - a for x, y in pairs for a, b in zip(x.position_trf_m, y.position_trf_m, strict=True)
    )
    target = DrawnBody(
        body="target",
        marker_shift_m=shifts if any(shifts) else (),
        **_plant_fields(target_plant(scenario)),
    )
    return DrawnTruth(tick=0, bodies=(target, *chasers))


def _drawn_chaser(scenario: Scenario, sensor: OdometrySensor, chaser: int) -> DrawnBody:
    actuation, camera = actuation_errors(scenario, chaser), camera_errors(scenario, chaser)
    position_bias, attitude_bias, gyro_bias = sensor.biases(chaser)
    return DrawnBody(
        body=f"chaser/{chaser}",
        **_plant_fields(chaser_plant(scenario, chaser)),
        thrust_share=vector(actuation.thrust_share),
        thrust_turn_rad=vector(actuation.thrust_turn_rad),
        clock_offset_s=actuation.clock_offset_s,
        position_bias_m=vector(position_bias),
        attitude_bias_rad=vector(attitude_bias),
        gyro_bias_rad_s=vector(gyro_bias),
        camera_turn_rad=vector(camera.turn_rad),
        camera_shift_m=vector(camera.shift_m),
        camera_focal_share=camera.focal_share,
        camera_centre_px=vector(camera.centre_px),
    )


def _plant_fields(plant: Plant) -> dict[str, Any]:
    return {
        "mass_kg": plant.mass_kg,
        "inertia_kg_m2": vector(plant.inertia_kg_m2),
        "centre_of_mass_m": vector(plant.centre_of_mass_m),
        "force_N": vector(plant.disturbance[:3]),
        "torque_N_m": vector(plant.disturbance[3:]),
    }


def _state_fields(state: BodyState) -> dict[str, Any]:
    return {
        "position_m": vector(state.position_m),
        "velocity_m_s": vector(state.velocity_m_s),
        "q_wxyz": vector(state.q_wxyz),
        "omega_rad_s": vector(state.omega_rad_s),
    }
