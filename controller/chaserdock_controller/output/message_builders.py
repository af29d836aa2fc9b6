# SPDX-License-Identifier: Apache-2.0
"""Builds messages from the results of a tick."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    Event,
    ExpectedPose,
    GeometryEstimate,
    Level,
    MassEstimate,
    Odometry,
    PassiveSafety,
    Plan,
    Reference,
    RelativeEstimate,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
)
from numpy.typing import ArrayLike

from chaserdock_controller.bodies.mass_properties import MassProperties
from chaserdock_controller.interfaces import (
    ChaserPlan,
    Directive,
    EstimatedShape,
    IdentifiedStack,
    Observation,
    PlanCertificate,
    PlanResult,
    ReferencePose,
    TargetEstimation,
    TargetState,
)


def plan_message(chaser: int, tick: int, step_s: float, plan: ChaserPlan) -> Plan:
    """Build the message of the plan that a chaser flies from a tick on."""
    return Plan(
        tick=tick,
        sim_time_ns=plan.time_ns,
        chaser=chaser,
        step_s=step_s,
        positions_m=vector(plan.states[:, :3]),
        quaternions_wxyz=vector(plan.states[:, 6:10]),
        inputs=vector(plan.inputs),
    )


def target_message(observation: Observation, estimation: TargetEstimation) -> TargetEstimate:
    """Build the message of the target's estimate."""
    target = estimation.target
    return TargetEstimate(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        status=target.status,  # type: ignore[arg-type]
        position_m=vector(target.position_m),
        velocity_m_s=vector(target.velocity_m_s),
        q_wxyz=vector(target.q_wxyz),
        omega_rad_s=vector(target.omega_rad_s),
        covariance=vector(target.covariance),
        accepted=tuple(
            c.chaser for c in estimation.chasers if c.visible and c.chaser not in target.rejected
        ),
        rejected=tuple(sorted(target.rejected)),
        cameras=tuple(c.camera for c in estimation.chasers if c.camera is not None),
        relative=tuple(
            RelativeEstimate(
                chaser=c.chaser,
                position_m=vector(c.relative.position_m),
                q_wxyz=vector(c.relative.q_wxyz),
                covariance=vector(c.relative.covariance),
                force_N=vector(c.own.disturbance[:3]),
                torque_N_m=vector(c.own.disturbance[3:]),
            )
            for c in estimation.chasers
            if c.own is not None and c.relative is not None
        ),
        innovations=estimation.innovations,
    )


def geometry_estimate(shape: EstimatedShape) -> GeometryEstimate:
    """Build the message of the estimated errors of the geometry, in their own units."""
    sigmas = np.array([p.sigma for p in shape.parameters])
    return GeometryEstimate(
        names=tuple(p.name for p in shape.parameters),
        sigmas=vector(sigmas),
        values=vector(sigmas * shape.values),
        covariance=vector(shape.covariance * np.outer(sigmas, sigmas)),
        views=shape.views,
        coverage=shape.coverage,
    )


def expected_pose(
    target: TargetState, own: Odometry, camera: Camera, time_ns: int, ahead_s: float
) -> ExpectedPose:
    """Return where the target will appear to a chaser's camera, ``ahead_s`` after the estimates of
    ``time_ns``.
    """
    p_own, q_own = _moved(own.position_m, own.velocity_m_s, own.q_wxyz, own.omega_rad_s, ahead_s)
    p, q = _moved(
        target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s, ahead_s
    )
    lens, q_camera = camera.irf_pose_in_world(p_own, q_own)
    return ExpectedPose(
        sim_time_ns=time_ns + round(ahead_s * 1e9),
        position_m=vector(rotations.rotate_inverse(q_camera, p - lens)),
        q_wxyz=vector(rotations.normalize(rotations.multiply(rotations.conjugate(q_camera), q))),
    )


def _moved(
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    time_s: float,
) -> tuple[Array, Array]:
    """Return position (3,) and attitude (4,) after a time at constant rates."""
    turn = rotations.exp(np.asarray(omega_rad_s) * time_s)
    return np.asarray(position_m) + time_s * np.asarray(velocity_m_s), rotations.multiply(
        q_wxyz, turn
    )


def stack_message(observation: Observation, stack: IdentifiedStack) -> StackEstimate:
    """Build the message of the identified mass properties."""
    return StackEstimate(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chasers=tuple(c.chaser for c in stack.chasers),
        stack=_mass_estimate(stack.stack),
        target=_mass_estimate(stack.target),
        thrust_factors=tuple(f for c in stack.chasers for f in vector(c.thrust_factors)),
        failed=tuple(stack.failed_of(c.chaser) for c in stack.chasers),
    )


def _mass_estimate(properties: MassProperties) -> MassEstimate:
    values = properties.values
    return MassEstimate(
        mass_kg=float(values[0]),
        centre_of_mass_m=vector(values[1:4]),
        inertia_kg_m2=vector(values[4:]),
        covariance=vector(properties.covariance),
    )


def reference_message(
    observation: Observation, directive: Directive, reference: ReferencePose
) -> Reference:
    """Build the message of a chaser's reference."""
    return Reference(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chaser=directive.chaser,
        phase=directive.phase,
        phase_time_s=directive.phase_time_s,
        position_m=vector(reference.position_m),
        q_wxyz=vector(reference.q_wxyz),
        offset_m=vector(reference.offset_m),
        min_distance_target_m=reference.min_distance_target_m,
    )


def solver_message(observation: Observation, solver: str, result: PlanResult) -> SolverStatus:
    """Build the message of the solver's status. Without a plan it lists no chasers."""
    solved = [(c.chaser, c.solve) for c in result.chasers if c.solve is not None]
    return SolverStatus(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        solver=solver,
        chasers=tuple(i for i, _ in solved),
        status=tuple(s.status for _, s in solved),
        iterations=tuple(s.iterations for _, s in solved),
        cost=tuple(s.cost for _, s in solved),
        max_violation_m=tuple(s.max_violation_m for _, s in solved),
        wall_solve_s=result.wall_s,
    )


def safety_message(
    observation: Observation, directive: Directive, certificate: PlanCertificate
) -> PassiveSafety:
    """Build the message of the certificate of a chaser's newest plan."""
    return PassiveSafety(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chaser=directive.chaser,
        margin_sigmas=certificate.coast.margin_sigmas,
        distance_m=certificate.coast.distance_m,
        closest_s=certificate.coast.time_s,
        loss_s=certificate.loss_s,
        safe=certificate.safe,
        enforced=directive.abort_margin is not None,
        abort_margin_sigmas=directive.abort_margin,
    )


def event_message(observation: Observation, level: Level, text: str) -> Event:
    """Build the message of an event of the controller."""
    return Event(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        process="controller",
        level=level,
        what=text,
    )
