# SPDX-License-Identifier: Apache-2.0
"""One sample of every message."""

from __future__ import annotations

from typing import Any

import msgspec
from chaserdock_protocol import messages as m

EYE12 = tuple(1.0 if i % 13 == 0 else 0.0 for i in range(144))
EYE6 = tuple(1.0 if i % 7 == 0 else 0.0 for i in range(36))
V, Q = (0.25, -1.5, 3.0), (0.5, -0.5, 0.5, -0.5)
HEAD: dict[str, Any] = {"seq": 7, "tick": 12, "sim_time_ns": 800_000_000}
SOLUTION = m.PoseSolution(position_m=V, q_wxyz=Q, covariance=EYE6, reprojection_rms_px=0.125)
PORT = m.ChosenPort(
    chaser=1, number=2, position_m=V, axis=(0.6, 0.0, -0.8),
    axis_sigma_rad=0.01, flatness_m=0.002, clearance_m=0.25, radius_m=0.125,
)  # fmt: skip
MASS = m.MassEstimate(
    mass_kg=150.5,
    centre_of_mass_m=V,
    inertia_kg_m2=(1.5, 2.5, 3.5, 0.25, -0.5, 0.125),
    covariance=(0.25,) * 100,
)

SAMPLES: tuple[msgspec.Struct, ...] = (
    m.Tick(
        **HEAD,
        revision=1,
        images=True,
        chasers=(0, 3),
        controllers={"controller": "c1", "standby": "s1"},
        since={"chaser/0": 3, "controller": 0},
    ),
    m.MissionEnd(**HEAD, reason="flown to its end", complete=True),
    m.Image(
        **HEAD,
        chaser=2,
        width_px=4,
        height_px=2,
        encoding="mono8",
        data=bytes(range(8)),
        ranging=m.RangeMeasurement(
            range_m=20.0,
            range_sigma_m=0.02,
            q_wxyz=(0.5, -0.5, 0.5, -0.5),
            attitude_covariance_rad2=(1e-6, 0.0, 0.0, 0.0, 2e-6, 0.0, 0.0, 0.0, 3e-6),
        ),
    ),
    m.FeatureTracks(
        **HEAD,
        chaser=1,
        status="seen",
        position_m=V,
        q_wxyz=Q,
        ids=(7, 12, 900),
        places=(64, -3, 61439, 17, 30720, 4097),
        ages=(0, 3, 250),
        described=(12,),
        descriptions=bytes(range(128)),
        ellipses=(480.5, 270.25, 50.0, 30.5, 0.75, 0.625),
    ),
    m.LandmarkMap(
        **HEAD,
        status="mapped",
        next_tick=102,
        instance="a1",
        motion=m.MappedMotion(
            position_m=V, velocity_m_s=V, q_wxyz=Q, omega_rad_s=V, covariance=EYE12
        ),
        landmarks_m=(0.25, -0.5, 0.75, 1.5, 0.125, -0.25),
        moments_m2=(0.5, 0.25, 0.125, -0.125, 0.0, 0.0625) * 2,
        tracks=(m.KnownTracks(chaser=1, ids=(7, 900), landmarks=(1, 0)),),
        scale_share=0.0025,
        residual_px=0.375,
        merges=4,
        closed=True,
        ports=(PORT,),
    ),
    m.Odometry(**HEAD, chaser=255, position_m=V, velocity_m_s=V, q_wxyz=Q, omega_rad_s=V),
    m.DockingStatus(**HEAD, chaser=1, contact=True, armed=True, latched=False),
    m.BodyTruth(**HEAD, body="chaser/0", position_m=V, velocity_m_s=V, q_wxyz=Q, omega_rad_s=V),
    m.BodyReference(
        **HEAD,
        body="target",
        source="optitrack",
        position_m=V,
        q_wxyz=Q,
        sigma_m=2e-4,
        sigma_rad=1e-3,
        omega_rad_s=V,
    ),
    m.DrawnTruth(
        **HEAD,
        bodies=(
            m.DrawnBody(
                body="chaser/0", mass_kg=12.5, inertia_kg_m2=(0.25,) * 9, centre_of_mass_m=V
            ),
        ),
    ),
    m.WorldTruth(**HEAD, contacts=(("chaser/0", "target"),), saturated=(1,), late_commands=2),
    m.PlumeLoad(**HEAD, body="target", impulse_N_s=V, angular_impulse_N_m_s=V, peak_force_N=0.5),
    m.PortLoad(
        **HEAD,
        chaser=1,
        force_N=V,
        torque_N_m=V,
        peak_force_N=4.0,
        peak_torque_N_m=4.5,
        peak_axial_N=0.25,
        peak_shear_N=3.5,
        peak_bending_N_m=3.25,
        closing_impulse_N_s=0.125,
    ),
    m.StackEstimate(
        **HEAD,
        chasers=(0, 3),
        stack=MASS,
        target=MASS,
        thrust_factors=(0.875, 1.0),
        failed=((1,), ()),
    ),
    m.Sighting(
        **HEAD,
        chaser=1,
        status="seen",
        solutions=(SOLUTION, SOLUTION),
        marker_ids=(0, 4),
        corners_px=tuple(float(i) for i in range(16)),
        rejected_ids=(17,),
        geometry=m.GeometryMeasurement(
            information=(4.0, 0.0, 0.0, 9.0),
            vector=(1.0, -2.0),
            position_m=V,
            position_by_errors=(0.001, 0.0, 0.0, 0.0, 0.0, 0.003),
            position_covariance_m2=(1e-8, 0.0, 0.0, 0.0, 1e-8, 0.0, 0.0, 0.0, 1e-6),
        ),
        acquiring=True,
        map=m.SightedMap(closed=True, port=PORT),
        wall_estimate_s=0.01,
    ),
    m.TargetEstimate(
        **HEAD,
        status="tracking",
        position_m=V,
        velocity_m_s=V,
        q_wxyz=Q,
        omega_rad_s=V,
        covariance=EYE12,
        accepted=(0,),
        rejected=(),
        cameras=(
            m.CameraCalibration(
                chaser=0,
                turn_rad=V,
                turn_sigma_rad=V,
                shift_m=V,
                shift_sigma_m=V,
                focal_share=1e-3,
                focal_sigma_share=5e-4,
            ),
        ),
        innovations=(
            m.Innovation(chaser=0, sim_time_ns=400_000_000, squared=5.5, freedoms=6, used=True),
        ),
    ),
    m.Reference(
        **HEAD,
        chaser=0,
        phase="approach",
        phase_time_s=1.5,
        position_m=V,
        q_wxyz=Q,
        offset_m=V,
        min_distance_target_m=0.35,
    ),
    m.WrenchCommand(
        **HEAD,
        chaser=0,
        effective_time_ns=9,
        expires_ns=10,
        mode="nmpc",
        force_N=V,
        torque_N_m=V,
        geometry=m.GeometryEstimate(
            names=("panel_left x", "scale"),
            sigmas=(0.01, 0.003),
            values=(0.004, -0.001),
            covariance=(1e-6, 0.0, 0.0, 1e-7),
            views=12,
            coverage=0.15,
        ),
        expected=m.ExpectedPose(sim_time_ns=9, position_m=V, q_wxyz=Q),
    ),
    m.Plan(**HEAD, chaser=0, step_s=0.1, positions_m=V * 2, quaternions_wxyz=Q * 2, inputs=V * 2),
    m.PassiveSafety(
        **HEAD,
        chaser=0,
        margin_sigmas=4.5,
        distance_m=1.5,
        closest_s=120.0,
        loss_s=3.0,
        safe=True,
        enforced=True,
        abort_margin_sigmas=9.0,
    ),
    m.SolverStatus(
        **HEAD,
        solver="rti",
        chasers=(0,),
        status=("solved",),
        iterations=(3,),
        cost=(1.5,),
        max_violation_m=(0.0,),
        wall_solve_s=0.01,
    ),
    m.AssuranceStatus(
        **HEAD,
        chaser=0,
        state="changed",
        hazards=("target", "rate"),
        asked_force_N=V,
        asked_torque_N_m=V,
        room_m=0.02,
        nearest="target",
    ),
    m.ActuatorCommand(
        **HEAD,
        chaser=0,
        effective_time_ns=9,
        source="brake",
        force_N=V,
        torque_N_m=V,
        pulses=(m.ThrusterPulse(thruster=3, open_ns=9, close_ns=19),),
        isolated=(0, 11),
    ),
    m.Lease(
        **HEAD,
        chaser=1,
        revision=1,
        holder="standby",
        instance="s1",
        term=2,
        from_tick=3,
        until_tick=9,
    ),
    m.ThrusterReport(
        **HEAD,
        chaser=0,
        force_max_N=V,
        torque_max_N_m=V,
        coming_impulse_N_s=V,
        coming_angular_impulse_N_m_s=V,
        thrusters=("healthy", "stuck_on", "weak"),
        isolated=(1,),
    ),
    m.Event(**HEAD, process="world", level="warning", what="process lost", detail="chaser/1 — ∆"),
    m.Health(**HEAD, process="chaser/0", rejected={"world/tick:format": 2}, lost=1, stale=0),
    m.RecorderAck(**HEAD),
    m.ThrusterFaultCommand(chaser=1, thruster=3, kind="weak", factor=0.5, operator="me"),
    m.PortRequest(
        chaser=1, image=0, pixel=(512.5, 270.25), exposed_ns=7, radii_m=(0.1, 0.2), operator="me"
    ),
    m.ArmingCommand(action="arm", operator="me"),
    m.ArmingReply(accepted=True, reason="armed by me"),
    m.Kill(**HEAD, by="a button"),
    m.OperatorCommand(**HEAD, command="goto", chaser=1, offset_m=V),
    m.CommandReply(**HEAD, command="goto", chaser=1, accepted=False, reason="no"),
    m.ControllerState(
        **HEAD,
        process="standby",
        term=2,
        operated=(m.OperatorCommand(command="hold", chaser=1),),
        state=b"\x80",
        commanded=(m.CommandedWrench(chaser=1, force_N=V, torque_N_m=V),),
    ),
    m.Presence(
        **HEAD, process="chaser/0", instance="abc", heard={"controller": "c1", "world": "w1"}
    ),
    m.Farewell(**HEAD, process="chaser/0", published={"chaser/0/sighting": 4}),
    m.JoinRequest(process="chaser/0", instance="abc"),
    m.JoinReply(
        accepted=True, reason="", run_id="r", mode="realtime", scenario_json="{}", faults="{}"
    ),
    m.ScenarioRequest(process="recorder"),
    m.ScenarioReply(run_id="r", scenario_json="{}"),
)
BY_TYPE: dict[type[msgspec.Struct], msgspec.Struct] = {type(s): s for s in SAMPLES}
