# SPDX-License-Identifier: Apache-2.0
"""Messages built from the results of a tick."""

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
    PassiveSafety,
    Plan,
    Reference,
    RelativeEstimate,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
)
from numpy.typing import ArrayLike

from chaserdock_controller.estimation.mass_properties import MassProperties
from chaserdock_controller.interfaces import (
    Directive,
    EstimatedShape,
    GuidanceResult,
    IdentifiedStack,
    Observation,
    PlanCertificate,
    PlanResult,
    TargetEstimation,
)
from chaserdock_controller.nmpc.plan_monitor import ChaserPlan


def plan_message(chaser: int, tick: int, step_s: float, plan: ChaserPlan) -> Plan:
    """Return the plan that one chaser flies from a tick on."""
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
    """Return the target's estimate."""
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
        accepted=tuple(sorted(estimation.visible_to - set(target.rejected))),
        rejected=tuple(sorted(target.rejected)),
        cameras=estimation.cameras,
        relative=tuple(
            RelativeEstimate(
                chaser=r.chaser,
                position_m=vector(r.position_m),
                q_wxyz=vector(r.q_wxyz),
                covariance=vector(r.covariance),
                force_N=vector(estimation.disturbances[r.chaser][:3]),
                torque_N_m=vector(estimation.disturbances[r.chaser][3:]),
            )
            for r in estimation.relative
            if r.chaser in estimation.disturbances
        ),
    )


def geometry_estimate(shape: EstimatedShape) -> GeometryEstimate:
    """Return the estimated errors of the geometry in their units."""
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
    chaser: int, estimation: TargetEstimation, camera: Camera, time_ns: int, ahead_s: float
) -> ExpectedPose:
    """Return where the target will be in the camera of a chaser, ``ahead_s`` after the estimates of
    ``time_ns``.
    """
    target, own = estimation.target, estimation.own[chaser]
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
    """Return the identified mass properties."""
    return StackEstimate(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chasers=tuple(stack.chasers),
        stack=_mass_estimate(stack.stack),
        target=_mass_estimate(stack.target),
        thrust_factors=tuple(f for i in stack.chasers for f in vector(stack.thrust_factors[i])),
        failed=tuple(stack.failed.get(i, ()) for i in stack.chasers),
    )


def _mass_estimate(properties: MassProperties) -> MassEstimate:
    values = properties.values
    return MassEstimate(
        mass_kg=float(values[0]),
        centre_of_mass_m=vector(values[1:4]),
        inertia_kg_m2=vector(values[4:]),
        covariance=vector(properties.covariance),
    )


def reference_message(chaser: int, observation: Observation, directive: Directive) -> Reference:
    """Return the reference of one chaser, which must have one."""
    reference = directive.reference
    assert reference is not None
    return Reference(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chaser=chaser,
        phase=directive.phase.value,
        phase_time_s=directive.phase_time_s,
        position_m=vector(reference.position_m),
        q_wxyz=vector(reference.q_wxyz),
        offset_m=vector(reference.offset_m),
        min_distance_target_m=reference.min_distance_target_m,
    )


def solver_message(observation: Observation, solver: str, result: PlanResult) -> SolverStatus:
    """Return the solver's status; without a plan it lists no chasers."""
    head = {"tick": observation.tick, "sim_time_ns": observation.time_ns, "solver": solver}
    plan, n = result.plan, len(result.chasers)
    if plan is None:
        return SolverStatus(
            **head,
            chasers=(),
            status=(),
            iterations=(),
            cost=(),
            max_violation_m=(),
            wall_solve_s=result.wall_s,
        )
    return SolverStatus(
        **head,
        chasers=result.chasers,
        status=plan.status[:n],
        iterations=tuple(int(k) for k in plan.iterations[:n]),
        cost=vector(plan.cost[:n]),
        max_violation_m=vector(plan.max_violation_m[:n]),
        wall_solve_s=result.wall_s,
    )


def safety_message(
    chaser: int, observation: Observation, guidance: GuidanceResult, certificate: PlanCertificate
) -> PassiveSafety:
    """Return the certificate of a chaser's newest plan."""
    return PassiveSafety(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        chaser=chaser,
        margin_sigmas=certificate.coast.margin_sigmas,
        distance_m=certificate.coast.distance_m,
        closest_s=certificate.coast.time_s,
        loss_s=certificate.loss_s,
        safe=certificate.safe,
        enforced=chaser in guidance.abort_margins,
        abort_margin_sigmas=guidance.abort_margins.get(chaser),
    )


def event_message(observation: Observation, level: Level, text: str) -> Event:
    """Return an event of the controller."""
    return Event(
        tick=observation.tick,
        sim_time_ns=observation.time_ns,
        process="controller",
        level=level,
        what=text,
    )
