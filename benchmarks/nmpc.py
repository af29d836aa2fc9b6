# SPDX-License-Identifier: Apache-2.0
"""Solve times and closed-loop cost of the NMPC back ends: ``python benchmarks/nmpc.py [--quick]
[--json FILE]``.

Hard case: D = 30 stages (3 s), cuboids of 10 kg, 3 N, 0.3 N m on a ring around the target; half of
the chasers swap positions with a neighbour, head-on. Closed loop, perfect state, 10 commands a
second. A solve is timed by wall clock and by the processor time of its thread, which load on the
machine affects less. ``--solver`` (repeatable) chooses solvers, ``--n`` (repeatable) the numbers of
chasers. Beside the product's back ends these are peers (`peers`): fatrop, alpaqa and acados, which
is timed by its own total time and by processor time. One that is not installed is listed with the
reason. A flight that uses more than ``--cell-s`` of processor time is shortened and reported as
such. ``--flights R`` repeats each case, identical to the bit, and takes the minimum time of each
tick, which excludes other load. Also: steady tracking at the paper's rates, the first solve of a
fresh process, and the compilation of the kernels.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from chaserdock_controller.guidance.reference import (
    feed_forward,
    predict_target,
    reference_state,
    reference_trajectory,
)
from chaserdock_controller.nmpc import (
    BACK_ENDS,
    NmpcInput,
    NmpcParameters,
    NmpcSolver,
    kernels,
    make_solver,
    native,
)
from chaserdock_controller.nmpc.problem import model_of
from chaserdock_controller.parameters import nmpc_settings
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.native.build import compile_kernels
from chaserdock_protocol.scenario.bodies import cuboid_inertia
from chaserdock_protocol.scenario.schema import Controller, Limits
from common import ROOT, Figures, make_parser, percentiles, print_figures, write_json
from peers import PEERS, make_peer

LABELS = ("median", "p95", "max")
TICK_S = 0.1
D_MIN_M = 0.35
SIZE_M = (0.25, 0.25, 0.05)


def parameters(mass_kg: float, force_N: float, torque_N_m: float) -> NmpcParameters:
    x, y, z = cuboid_inertia(mass_kg, SIZE_M)
    inertia = ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z))
    return NmpcParameters(
        mass_kg, inertia, force_N, torque_N_m, **nmpc_settings(Controller(), Limits())
    )


HARD = parameters(10.0, 3.0, 0.3)
PAPER = parameters(30.0, 2.0, 0.05)


def advance(states: Array, inputs: Array, params: NmpcParameters, duration_s: float) -> Array:
    """Return the states after ``duration_s`` under constant inputs (N, 6); integrates with a
    quarter of the step.
    """
    x = np.empty((len(states), 5, 13))
    x[:, 0] = states
    held = np.repeat(inputs[:, None], 4, axis=1)
    kernels.roll(model_of(params, duration_s / 4), x, held)
    return x[:, -1].copy()


def hard_case(n: int) -> tuple[Array, NmpcInput]:
    """Return states at rest, and the problem, whose states change at each tick."""
    radius_m = max(1.0, 0.8 * n / (2.0 * np.pi))
    angle = 2.0 * np.pi * np.arange(n) / max(n, 2)
    positions = radius_m * np.stack([-np.cos(angle), -np.sin(angle), np.zeros(n)], axis=1)
    goals = positions.copy()
    for i in range(0, n - 1, 4):
        goals[[i, i + 1]] = goals[[i + 1, i]]
    if n == 1:
        goals[0] = [0.8, 0.3, 0.1]  # past the target
    states = np.zeros((n, 13))
    states[:, :3], states[:, 6] = positions, 1.0
    pose = np.concatenate([goals, np.tile([1.0, 0, 0, 0], (n, 1))], axis=1)
    d = HARD.stages
    return states, NmpcInput(
        states=states,
        references=np.repeat(pose[:, None], d + 1, axis=1),
        u_ref=np.zeros((n, d, 6)),
        target_positions=np.zeros((d + 1, 3)),
        min_distance_target_m=np.full(n, D_MIN_M),
        min_distance_chasers_m=D_MIN_M,
        input_max=np.tile(HARD.input_limits(), (n, 1)),
    )


@dataclass
class Flown:
    """Solve times of all ticks, closed-loop cost, smallest margin of a distance, and failed
    solves.
    """

    wall_s: Array
    cpu_s: Array
    cost: float
    margin_m: float
    failures: int


def fly_hard(solver: NmpcSolver, n: int, ticks: int, cell_s: float) -> Flown:
    """Fly the hard case in closed loop; end early after ``cell_s`` of processor time."""
    states, problem = hard_case(n)
    solver.reset()
    wall, cpu, cost, margin_m, failures = [], [], 0.0, np.inf, 0
    for k in range(ticks):
        now = replace(problem, states=states)
        begin_s, begin_cpu_s = time.perf_counter(), time.thread_time()
        plan = solver.solve(now, TICK_S if k else 0.0)
        wall.append(time.perf_counter() - begin_s)
        cpu.append(time.thread_time() - begin_cpu_s)
        if (own := getattr(solver, "solve_time", None)) is not None:
            wall[-1], cpu[-1] = own.wall_s, own.cpu_s
        failures += plan.status.count("failed")
        goal = problem.references[:, 0]
        error = [
            rotations.multiply(x[6:10], rotations.conjugate(g[3:]))[1:]
            for x, g in zip(states, goal, strict=True)
        ]
        cost += TICK_S * (
            65.0 * np.sum((states[:, :3] - goal[:, :3]) ** 2) + 35.0 * np.sum(np.square(error))
        )
        cost += TICK_S * np.sum(np.array([3.5] * 3 + [40.0] * 3) * plan.inputs[:, 0] ** 2)
        states = advance(states, plan.inputs[:, 0], HARD, TICK_S)
        gaps = np.linalg.norm(states[:, None, :3] - states[None, :, :3], axis=-1) + 9.0 * np.eye(n)
        nearest = min(float(gaps.min()), float(np.linalg.norm(states[:, :3], axis=-1).min()))
        margin_m = min(margin_m, nearest - D_MIN_M)
        if sum(cpu) > cell_s:
            break
    return Flown(np.array(wall), np.array(cpu), float(cost), float(margin_m), failures)


def tracking(gain: float, duration_s: float) -> tuple[float, float]:
    """Return steady RMS errors of position (m) and orientation (rad) of `rti` at the paper's rates
    with feed-forward.

    Perfect state, 15 commands a second; actuators deliver ``gain`` times the command. The second
    half is evaluated.
    """
    v, w = np.array([1.5e-2, 0.75e-2, 3e-2]), np.array([1.5e-2, 4.5e-2, 3e-2])
    offset, q_off, tick_s, d = (
        np.array([-1.0, 0, 0]),
        np.array([1.0, 0, 0, 0]),
        1.0 / 15.0,
        PAPER.stages,
    )
    times = PAPER.dt_s * np.arange(d + 1)
    wrench = feed_forward(
        w,
        np.tile(offset, (d, 1)),
        np.zeros((d, 3)),
        np.zeros((d, 3)),
        q_off,
        PAPER.mass_kg,
        PAPER.inertia_kg_m2,
    )
    states = reference_state(np.zeros(3), v, [1.0, 0, 0, 0], w, offset, np.zeros(3), q_off)[None]
    solver = make_solver("rti", PAPER, 1)
    errors = []
    ticks = round(duration_s / tick_s)
    for k in range(ticks + 1):
        p, q = (a[0] for a in predict_target(np.zeros(3), v, [1.0, 0, 0, 0], w, [k * tick_s]))
        reference = reference_trajectory(p, v, q, w, offset, q_off, times)
        angle = rotations.angle_between(states[0, 6:10], reference[0, 3:])
        errors.append((np.linalg.norm(states[0, :3] - reference[0, :3]), angle))
        problem = NmpcInput(
            states=states,
            references=reference[None],
            u_ref=wrench[None],
            target_positions=predict_target(p, v, q, w, times)[0],
            min_distance_target_m=np.array([D_MIN_M]),
            min_distance_chasers_m=D_MIN_M,
            input_max=PAPER.input_limits()[None],
        )
        plan = solver.solve(problem, tick_s if k else 0.0)
        states = advance(states, gain * plan.inputs[:, 0], PAPER, tick_s)
    position_m, angle_rad = np.sqrt(np.mean(np.square(errors[ticks // 2 :]), axis=0))
    return float(position_m), float(angle_rad)


def solver_of(name: str, n: int) -> NmpcSolver:
    """Return a back end or a peer. Raises ValueError if it is unavailable."""
    return make_peer(name, HARD, n) if name in PEERS else make_solver(name, HARD, n)


def first_solve_s(solver: str) -> float:
    """Return the wall time from the start of a process to the end of its first solve with four
    chasers.
    """
    code = (
        "import sys; sys.path.insert(0, 'benchmarks'); import nmpc; s, p = nmpc.hard_case(4); "
        f"nmpc.make_solver({solver!r}, nmpc.HARD, 4).solve(p, 0.0)"
    )
    begin_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    return time.perf_counter() - begin_s


def compilation_s() -> float:
    """Return the wall time to compile the kernels of the NMPC with an empty cache."""
    begin_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        sources = shutil.copytree(native.LIBRARY.path.parent, Path(folder) / "native")
        compile_kernels(sources)
    return time.perf_counter() - begin_s


def measure(names: list[str], sizes: list[int], ticks: int, cell_s: float, flights: int) -> Figures:
    """Fly the hard case with each back end and number of chasers; print a line for each."""
    out: Figures = {}
    columns = "wall ms median/p95/max   cpu ms median/p95/max   margin mm  failed  cost"
    print(f"{'':16}{'N':>3} {'ticks':>5}  {columns}")
    for name in names:
        for n in sizes:
            try:
                solver = solver_of(name, n)
            except ValueError as error:
                print(f"{name:16} not measured: {error}")
                break
            flown = fly_hard(solver, n, ticks, cell_s)
            for _ in range(flights - 1):
                repeated = fly_hard(solver, n, len(flown.wall_s), np.inf)
                flown.wall_s = np.minimum(flown.wall_s, repeated.wall_s)
                flown.cpu_s = np.minimum(flown.cpu_s, repeated.cpu_s)
            key = f"{name}_n{n}"
            times = percentiles(flown.wall_s, f"{key}_solve_wall", "s", *LABELS)
            times |= percentiles(flown.cpu_s, f"{key}_solve_cpu", "s", *LABELS)
            complete = len(flown.wall_s) == ticks
            out |= {
                **times,
                f"{key}_ticks": len(flown.wall_s),
                f"{key}_margin_m": flown.margin_m,
                f"{key}_failures": flown.failures,
            }
            if complete:
                out[f"{key}_closed_loop_cost"] = flown.cost
            cells = " ".join(f"{1e3 * value:8.2f}" for value in times.values())
            print(
                f"{name:16}{n:3d} {len(flown.wall_s):5d} {cells} {1e3 * flown.margin_m:9.1f} "
                f"{flown.failures:6d}  {f'{flown.cost:.3f}' if complete else 'shortened'}",
                flush=True,
            )
            if not complete:
                break
    return out


def ratios(figures: Figures) -> Figures:
    """Return each back end's closed-loop cost relative to ipopt, its solve times relative to rti,
    and rti's growth with N.
    """
    out: Figures = {}
    for key, value in figures.items():
        name, _, rest = key.partition("_n")
        if rest.endswith("closed_loop_cost") and name != "ipopt" and f"ipopt_n{rest}" in figures:
            out[f"{key}_over_ipopt"] = value / figures[f"ipopt_n{rest}"]
        if (
            re.search("solve_cpu_(median|p95|max)", rest)
            and name != "rti"
            and f"rti_n{rest}" in figures
        ):
            out[f"{key.removesuffix('_s')}_over_rti"] = value / figures[f"rti_n{rest}"]
    for label in LABELS:
        one, many = (figures.get(f"rti_n{n}_solve_cpu_{label}_s") for n in (1, 16))
        if one and many:
            out[f"rti_growth_1_to_16_{label}"] = many / one
    return out


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--solver", action="append", choices=(*BACK_ENDS, *PEERS))
    parser.add_argument("--n", action="append", type=int, choices=range(1, 17), metavar="N")
    parser.add_argument("--cell-s", type=float, default=120.0, help="processor time of a flight")
    parser.add_argument("--flights", type=int, default=1, metavar="R")
    options = parser.parse_args()
    sizes, ticks, cell_s, duration_s = (
        ([1, 2, 4], 30, 10.0, 20.0)
        if options.quick
        else ([1, 2, 4, 8, 16], 150, options.cell_s, 60.0)
    )
    usual = [name for name in BACK_ENDS if name != "open" or not options.quick]
    names: list[str] = options.solver or [*usual, *PEERS]
    result = measure(names, options.n or sizes, ticks, cell_s, options.flights)
    more = ratios(result)
    if "rti" in names:
        for label, gain in (("", 1.0), ("_actuators_5_percent_stronger", 1.05)):
            position_m, angle_rad = tracking(gain, duration_s)
            more[f"tracking{label}_position_rms_m"] = position_m
            more[f"tracking{label}_orientation_rms_rad"] = angle_rad
        more["rti_first_solve_wall_s"] = first_solve_s("rti")
    if importlib.util.find_spec("ziglang") is None:
        print("compilation not measured: ziglang is not installed")
    else:
        more["kernels_compilation_wall_s"] = compilation_s()
    print_figures(more)
    write_json(options.json, result | more)


if __name__ == "__main__":
    main()
