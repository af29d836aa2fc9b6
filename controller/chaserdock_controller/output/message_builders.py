"""What the controller knows, as messages and in words."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Plan, TargetEstimate, Tick, WrenchCommand
from chaserdock_protocol.messages.fields import CameraCalibration

from chaserdock_controller.estimation import Mekf
from chaserdock_controller.estimation.types import Estimator, TargetState
from chaserdock_controller.nmpc import NmpcPlan


def plan_message(chaser: int, tick: int, effective_ns: int, step_s: float, plan: NmpcPlan, row: int) -> Plan:
    """The plan of one chaser, which is in a row of the solver's."""
    return Plan(
        tick=tick,
        sim_time_ns=effective_ns,
        chaser=chaser,
        step_s=step_s,
        positions_m=vector(plan.states[row, :, :3]),
        quaternions_wxyz=vector(plan.states[row, :, 6:10]),
        inputs=vector(plan.inputs[row]),
    )


def target_message(
    tick: int, time_ns: int, fused: TargetState, seen: set[int], estimator: Estimator, camera: Camera
) -> TargetEstimate:
    """The fused state; ``seen``: chasers whose sightings of the target came for this tick."""
    return TargetEstimate(
        tick=tick,
        sim_time_ns=time_ns,
        status=fused.status,  # type: ignore[arg-type]
        position_m=vector(fused.position_m),
        velocity_m_s=vector(fused.velocity_m_s),
        q_wxyz=vector(fused.q_wxyz),
        omega_rad_s=vector(fused.omega_rad_s),
        covariance=vector(fused.covariance),
        accepted=tuple(sorted(seen - set(fused.rejected))),
        rejected=tuple(sorted(fused.rejected)),
        cameras=calibrations(estimator, camera),
    )


def calibrations(estimator: Estimator, camera: Camera) -> tuple[CameraCalibration, ...]:
    """Of every camera seen so far, if this estimator finds them out; ``camera``: as all are told to be."""
    if not isinstance(estimator, Mekf):
        return ()
    axes = rotations.to_matrix(camera.q_crf_irf_wxyz)
    found = []
    for e in estimator.cameras():
        turn, shift = (axes @ e.covariance[i : i + 3, i : i + 3] @ axes.T for i in (0, 3))
        found.append(
            CameraCalibration(
                chaser=e.chaser,
                turn_rad=vector(axes @ e.turn_rad),
                turn_sigma_rad=vector(np.sqrt(np.diag(turn))),
                shift_m=vector(axes @ e.shift_m),
                shift_sigma_m=vector(np.sqrt(np.diag(shift))),
                focal_share=e.focal_share,
                focal_sigma_share=float(np.sqrt(e.covariance[6, 6])),
            )
        )
    return tuple(found)


def in_words(c: CameraCalibration) -> str:
    """One line for the log."""
    turn, sigma = (", ".join(f"{np.degrees(v):.3f}" for v in x) for x in (c.turn_rad, c.turn_sigma_rad))
    return f"camera calibrated: turned by ({turn}) deg in CRF, sigma ({sigma}) deg"


def no_command(chaser: int, tick: Tick) -> WrenchCommand:
    """Tells a chaser, that may be waiting for it, that there is no command for this tick."""
    zero = (0.0, 0.0, 0.0)
    return WrenchCommand(
        tick=tick.tick,
        sim_time_ns=tick.sim_time_ns,
        chaser=chaser,
        effective_time_ns=tick.sim_time_ns,
        expires_ns=tick.sim_time_ns,
        mode="none",
        force_N=zero,
        torque_N_m=zero,
    )
