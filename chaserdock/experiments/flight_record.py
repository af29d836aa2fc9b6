# SPDX-License-Identifier: Apache-2.0
"""Records a whole in-process mission as arrays: states, tracking errors, commands, actuator
output.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from chaserdock_controller.interfaces import TickOutputs
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.rendering.cameras import States

from .in_process import InProcessMission, TickRecord
from .perception import PerceptionModel


@dataclass(frozen=True)
class FlightRecord:
    """A flight of N chasers over K - 1 ticks.

    ``time_s`` (K,): every tick and the end. ``states`` (K, N, 13): p, v (WRF), q_wxyz, omega
    (body). ``position_error_m``, ``orientation_error_rad`` (K, N): from the reference pose on the
    true target. ``target_distance_m`` (K, N): between the centres of chaser and target.
    ``solve_s``: wall-clock seconds of every controller tick. ``commands``: by tick, then chaser.
    Per chaser (N,): ``absolute_impulse_N_s`` (integral of the force components' magnitudes),
    ``thruster_impulse_N_s``, ``propellant_kg``. ``thruster_events``: (time in s, chaser, text).
    """

    time_s: Array
    states: Array
    position_error_m: Array
    orientation_error_rad: Array
    target_distance_m: Array
    solve_s: Array
    failed_solves: int
    commands: list[dict[int, ActuatorCommand]]
    absolute_impulse_N_s: Array
    thruster_impulse_N_s: Array
    propellant_kg: Array
    thruster_events: list[tuple[float, int, str]]

    def rms(self, from_s: float, chaser: int = 0) -> tuple[float, float]:
        """Return a chaser's RMS tracking errors (m, rad) from a time on."""
        late = self.time_s >= from_s
        errors = self.position_error_m[late, chaser], self.orientation_error_rad[late, chaser]
        position_m, angle_rad = (float(np.sqrt(np.mean(np.square(e)))) for e in errors)
        return position_m, angle_rad

    def commands_of(self, chaser: int) -> list[ActuatorCommand]:
        """Return a chaser's actuator commands in the order of their ticks."""
        return [by_chaser[chaser] for by_chaser in self.commands if chaser in by_chaser]


def record_flight(
    scenario: Scenario,
    perception: PerceptionModel | None = None,
    *,
    actuator_gain: float = 1.0,
    solve_delay_s: Callable[[float], float] | None = None,
) -> FlightRecord:
    """Fly a scenario to its end; for the arguments see ``InProcessMission``."""
    options = {"actuator_gain": actuator_gain, "solve_delay_s": solve_delay_s}
    with InProcessMission(scenario, perception, **options) as mission:  # type: ignore[arg-type]
        ticks = list(mission.ticks())
        final = mission.states()
        errors = [_rows(mission, t.tracking_errors) for t in ticks]
        errors.append(
            _rows(mission, {i: mission.tracking_error(i, final) for i in mission.chasers})
        )
        events = mission.thruster_events
        end_s = mission.time_s
    names = [f"chaser/{i}" for i in mission.chasers]
    all_states = [*(t.states for t in ticks), final]
    states = np.array([_state_rows(s, names) for s in all_states])
    target_m = np.array([s[TARGET].position_m for s in all_states])
    solved = [t.outputs for t in ticks if t.outputs is not None]
    error = np.array(errors)
    return FlightRecord(
        time_s=np.array([*(t.time_s for t in ticks), end_s]),
        states=states,
        position_error_m=error[..., 0],
        orientation_error_rad=error[..., 1],
        target_distance_m=np.linalg.norm(states[..., :3] - target_m[:, None], axis=2),
        solve_s=np.array([o.solver.wall_solve_s if o.solver is not None else 0.0 for o in solved]),
        failed_solves=sum(map(failed_solves, solved)),
        commands=[t.commands for t in ticks],
        absolute_impulse_N_s=_total(ticks, lambda d: d.absolute_impulse_N_s),
        thruster_impulse_N_s=_total(ticks, lambda d: sum(d.thruster_impulse_N_s)),
        propellant_kg=_total(ticks, lambda d: d.propellant_kg),
        thruster_events=events,
    )


def failed_solves(outputs: TickOutputs) -> int:
    """Return the number of chasers whose problem was not solved; 1 if there was no solution at
    all.
    """
    if outputs.solver is None or not outputs.solver.status:
        return 1
    return outputs.solver.status.count("failed")


def _rows(
    mission: InProcessMission, errors: dict[int, tuple[float, float]]
) -> list[tuple[float, float]]:
    return [errors[i] for i in mission.chasers]


def _state_rows(states: States, names: list[str]) -> list[Array]:
    each = (states[name] for name in names)
    return [np.concatenate([s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s]) for s in each]


def _total(ticks: list[TickRecord], value) -> Array:
    return np.sum([[float(value(d)) for d in t.delivered.values()] for t in ticks], axis=0)
