# SPDX-License-Identifier: Apache-2.0
"""Output of a chaser's actuators per tick: true, or as commanded in a log without ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from chaserdock_models.arrays import Vector3, limited
from chaserdock_models.thruster_model import G0_M_S2
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth
from chaserdock_protocol.scenario.bodies import Body

OutputSource = Literal["true", "commanded"]


class TickOutput(NamedTuple):
    """Impulses over a tick that ends at ``time_s``. Fields as in ``BodyTruth``."""

    time_s: float
    impulse_N_s: Vector3
    angular_impulse_N_m_s: Vector3
    absolute_impulse_N_s: float
    thruster_impulse_N_s: tuple[float, ...]
    thruster_open_s: tuple[float, ...]
    propellant_kg: float


def true_output(message: BodyTruth) -> TickOutput:
    """Return what the actuators gave up to a true state."""
    m = message
    return TickOutput(
        m.sim_time_ns / 1e9,
        m.impulse_N_s,
        m.angular_impulse_N_m_s,
        m.absolute_impulse_N_s,
        m.thruster_impulse_N_s,
        m.thruster_open_s,
        m.propellant_kg,
    )


def commanded_output(command: ActuatorCommand, body: Body, tick_s: float) -> TickOutput:
    """Return what a command asks of the actuators over its tick of ``tick_s``: force and torque
    within the limits of ideal ones, or the stated thrust while a valve is to be open.

    ``absolute_impulse_N_s`` adds the components of each thruster, so that thrusters that fire
    against each other count.
    """
    time_s = command.sim_time_ns / 1e9 + tick_s
    if body.actuation != "thrusters":
        wrench = np.array([*command.force_N, *command.torque_N_m])
        fx, fy, fz, tx, ty, tz = (limited(wrench, body.wrench_max) * tick_s).tolist()
        total = float(abs(fx) + abs(fy) + abs(fz))
        return TickOutput(time_s, (fx, fy, fz), (tx, ty, tz), total, (), (), 0.0)
    open_s = np.zeros(len(body.thrusters))
    for pulse in command.pulses:
        if pulse.thruster < len(open_s) and pulse.thruster not in command.isolated:
            open_s[pulse.thruster] += (pulse.close_ns - pulse.open_ns) / 1e9
    given = open_s * [t.thrust_N for t in body.thrusters]
    matrix = wrench_matrix(body.thrusters)
    x, y, z, a, b, c = (matrix @ given).tolist()
    return TickOutput(
        time_s,
        (x, y, z),
        (a, b, c),
        float(np.abs(matrix[:3] * given).sum()),
        tuple(given.tolist()),
        tuple(open_s.tolist()),
        float(np.sum(given / [t.isp_s * G0_M_S2 for t in body.thrusters])),
    )


@dataclass
class ImpulseTotals:
    """Impulses of a chaser's actuators over a flight: time integral of the absolute force
    components, sum over all thrusters, and their propellant.
    """

    absolute_N_s: float = 0.0
    thrusters_N_s: float = 0.0
    propellant_kg: float = 0.0

    def add(self, output: TickOutput) -> None:
        self.absolute_N_s += output.absolute_impulse_N_s
        self.thrusters_N_s += sum(output.thruster_impulse_N_s)
        self.propellant_kg += output.propellant_kg
