# SPDX-License-Identifier: Apache-2.0
"""How fast each NMPC back end solves, and how well it flies: ``python benchmarks/nmpc.py [--quick] [--json FILE]``.

The hard case: D = 30 stages (3 s), cuboids of 10 kg, 3 N, 0.3 N m, on a ring about a target; half of the chasers
start swapped with a neighbour, head-on. Closed loop, perfect state, 10 commands a second, each solve timed by the wall
clock and by the thread's processor time (which a busy machine disturbs less). ``--quick``: fewer chasers and
ticks. ``--solver`` (repeatable) chooses back ends, ``--n`` (repeatable) the numbers of chasers. One that
cannot be had is named with its reason; one that takes more than ``--cell-s`` of processor time for a number of
chasers is flown for as many ticks as fit, and says so. acados (`acados_peer.py`) is measured wherever its Python package is
installed, coupled and decoupled, by its own total time and the thread's processor time around its call. ``--flights R``
flies every case R times, the same to the bit, and counts the least time of each tick: what others do on the machine adds.
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
from acados_peer import KINDS, AcadosPeer
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
from chaserdock_controller.parameters import nmpc_settings
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.native.build import compile_kernels
from chaserdock_protocol.scenario.bodies import cuboid_inertia
from chaserdock_protocol.scenario.schema import Controller, Limits
from results import options_of, write_json

TICK_S = 0.1
D_MIN_M = 0.35
SIZE_M = (0.25, 0.25, 0.05)


def parameters(mass_kg: float, force_N: float, torque_N_m: float) -> NmpcParameters:
    x, y, z = cuboid_inertia(mass_kg, SIZE_M)
    inertia = ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z))
    return NmpcParameters(mass_kg, inertia, force_N, torque_N_m, **nmpc_settings(Controller(), Limits()))


HARD = parameters(10.0, 3.0, 0.3)
PAPER = parameters(30.0, 2.0, 0.05)


def advance(states: Array, inputs: Array, params: NmpcParameters, duration_s: float) -> Array:
    """The true motion under held inputs (N, 6): a finer integration than the plan's."""
    x = np.empty((len(states), 5, 13))
    x[:, 0] = states
    held = np.repeat(inputs[:, None], 4, axis=1)
    kernels.roll(kernels.model_of(params, duration_s / 4), x, held)
    return x[:, -1].copy()


def hard_case(n: int) -> tuple[Array, NmpcInput]:
    """States at rest and the problem (its states to be replaced tick by tick)."""
    radius_m = max(1.0, 0.8 * n / (2.0 * np.pi))
    angle = 2.0 * np.pi * np.arange(n) / max(n, 2)
    places = radius_m * np.stack([-np.cos(angle), -np.sin(angle), np.zeros(n)], axis=1)
    goals = places.copy()
    for i in range(0, n - 1, 4):
        goals[[i, i + 1]] = goals[[i + 1, i]]
    if n == 1:
        goals[0] = [0.8, 0.3, 0.1]  # past the target
    states = np.zeros((n, 13))
    states[:, :3], states[:, 6] = places, 1.0
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
    wall_s: Array
    cpu_s: Array
    cost: float
    margin_m: float
    failures: int


def fly_hard(solver: NmpcSolver, n: int, ticks: int, cell_s: float) -> Flown:
    """Closed loop on the hard case; ends early after ``cell_s`` of processor time."""
    states, problem = hard_case(n)
    solver.reset()
    wall, cpu, cost, margin_m, failures = [], [], 0.0, np.inf, 0
    for k in range(ticks):
        now = replace(problem, states=states)
        t, c = time.perf_counter(), time.thread_time()
        plan = solver.solve(now, TICK_S if k else 0.0)
        wall.append(time.perf_counter() - t)
        cpu.append(time.thread_time() - c)
        if isinstance(solver, AcadosPeer):
            wall[-1], cpu[-1] = solver.spent.wall_s, solver.spent.cpu_s
        failures += plan.status.count("failed")
        goal = problem.references[:, 0]
        error = [
            rotations.multiply(x[6:10], rotations.conjugate(g[3:]))[1:]
            for x, g in zip(states, goal, strict=True)
        ]
        cost += TICK_S * (65.0 * np.sum((states[:, :3] - goal[:, :3]) ** 2) + 35.0 * np.sum(np.square(error)))
        cost += TICK_S * np.sum(np.array([3.5] * 3 + [40.0] * 3) * plan.inputs[:, 0] ** 2)
        states = advance(states, plan.inputs[:, 0], HARD, TICK_S)
        gaps = np.linalg.norm(states[:, None, :3] - states[None, :, :3], axis=-1) + 9.0 * np.eye(n)
        nearest = min(float(gaps.min()), float(np.linalg.norm(states[:, :3], axis=-1).min()))
        margin_m = min(margin_m, nearest - D_MIN_M)
        if sum(cpu) > cell_s:
            break
    return Flown(np.array(wall), np.array(cpu), float(cost), float(margin_m), failures)


def tracking(stronger: float, time_s: float) -> tuple[float, float]:
    """Steady RMS of position, m, and orientation, degrees, at the paper's tumble with feed-forward (`rti`).

    Perfect state, 15 commands a second; actuators ``stronger`` times the modelled. The second half counts.
    """
    v, w = np.array([1.5e-2, 0.75e-2, 3e-2]), np.array([1.5e-2, 4.5e-2, 3e-2])
    offset, q_off, tick_s, d = np.array([-1.0, 0, 0]), np.array([1.0, 0, 0, 0]), 1.0 / 15.0, PAPER.stages
    times = PAPER.dt_s * np.arange(d + 1)
    wrench = feed_forward(w, np.tile(offset, (d, 1)), np.zeros((d, 3)), np.zeros((d, 3)), q_off, PAPER.mass_kg,
                          PAPER.inertia_kg_m2)  # fmt: skip
    states = reference_state(np.zeros(3), v, [1.0, 0, 0, 0], w, offset, np.zeros(3), q_off)[None]
    solver = make_solver("rti", PAPER, 1)
    errors = []
    ticks = round(time_s / tick_s)
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
        states = advance(states, stronger * plan.inputs[:, 0], PAPER, tick_s)
    position_m, angle_rad = np.sqrt(np.mean(np.square(errors[ticks // 2 :]), axis=0))
    return float(position_m), float(np.degrees(angle_rad))


def solver_of(name: str, n: int) -> NmpcSolver:
    """A back end, or "acados_coupled", "acados_decoupled". Raises ValueError where it cannot be had."""
    if not name.startswith("acados_"):
        return make_solver(name, HARD, n)
    try:
        return AcadosPeer(name.removeprefix("acados_"), HARD, n)
    except (ImportError, OSError, RuntimeError) as error:
        raise ValueError(str(error)) from error


def start(solver: str) -> float:
    """Seconds from the start of a fresh Python to the end of a first solve of four chasers."""
    code = (
        "import sys; sys.path.insert(0, 'benchmarks'); import nmpc; s, p = nmpc.hard_case(4); "
        f"nmpc.make_solver({solver!r}, nmpc.HARD, 4).solve(p, 0.0)"
    )
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).resolve().parents[1], check=True)
    return time.perf_counter() - begun


def compilation() -> float:
    """Seconds to compile the NMPC's kernels from nothing, as the package's build does, with an empty cache."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        sources = shutil.copytree(native.LIBRARY.path.parent, Path(folder) / "native")
        compile_kernels(sources)
    return time.perf_counter() - begun


def measure(
    names: list[str], sizes: list[int], ticks: int, cell_s: float, flights: int = 1
) -> dict[str, float]:
    out: dict[str, float] = {}
    print(
        f"{'':16}{'N':>3} {'ticks':>5}  wall ms median/p95/max   cpu ms median/p95/max   margin mm  failed  cost"
    )
    for name in names:
        for n in sizes:
            try:
                solver = solver_of(name, n)
            except ValueError as error:
                print(f"{name:16} not measured: {error}")
                break
            flown = fly_hard(solver, n, ticks, cell_s)
            for _ in range(flights - 1):
                again = fly_hard(solver, n, len(flown.wall_s), np.inf)
                flown.wall_s = np.minimum(flown.wall_s, again.wall_s)
                flown.cpu_s = np.minimum(flown.cpu_s, again.cpu_s)
            key = f"{name}_n{n}"
            cells = []
            for kind, times in (("wall", flown.wall_s), ("cpu", flown.cpu_s)):
                for label, value in zip(
                    ("median", "p95", "max"), (*np.percentile(times, [50, 95]), times.max()), strict=True
                ):
                    out[f"{key}_solve_{kind}_{label}_s"] = float(value)
                    cells.append(f"{1e3 * value:8.2f}")
            whole = len(flown.wall_s) == ticks
            out[f"{key}_ticks"] = len(flown.wall_s)
            out[f"{key}_margin_m"] = flown.margin_m
            out[f"{key}_failures"] = flown.failures
            if whole:
                out[f"{key}_closed_loop_cost"] = flown.cost
            print(
                f"{name:16}{n:3d} {len(flown.wall_s):5d} {' '.join(cells)} {1e3 * flown.margin_m:9.1f} "
                f"{flown.failures:6d}  {f'{flown.cost:.3f}' if whole else 'cut short'}",
                flush=True,
            )
            if not whole:
                break
    return out | compared(out)


def compared(figures: dict[str, float]) -> dict[str, float]:
    """Each back end's closed-loop cost over ipopt's, its solve times (processor) over rti's, and rti's growth with N."""
    out: dict[str, float] = {}
    for key, value in figures.items():
        name, _, rest = key.partition("_n")
        if rest.endswith("closed_loop_cost") and name != "ipopt" and f"ipopt_n{rest}" in figures:
            out[f"{key}_over_ipopt"] = value / figures[f"ipopt_n{rest}"]
        if re.search("solve_cpu_(median|p95|max)", rest) and name != "rti" and f"rti_n{rest}" in figures:
            out[f"{key.removesuffix('_s')}_over_rti"] = value / figures[f"rti_n{rest}"]
    for label in ("median", "p95", "max"):
        one, many = (figures.get(f"rti_n{n}_solve_cpu_{label}_s") for n in (1, 16))
        if one and many:
            out[f"rti_growth_1_to_16_{label}"] = many / one
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--solver", action="append", choices=BACK_ENDS)
    parser.add_argument("--n", action="append", type=int, choices=range(1, 17), metavar="N")
    parser.add_argument("--cell-s", type=float, default=120.0)
    parser.add_argument("--flights", type=int, default=1, metavar="R")
    options = parser.parse_args()
    sizes, ticks = ([1, 2, 4], 30) if options.quick else ([1, 2, 4, 8, 16], 150)
    names: list[str] = options.solver or (
        [n for n in BACK_ENDS if n != "open"] if options.quick else list(BACK_ENDS)
    )
    acados = [f"acados_{kind}" for kind in KINDS]
    cell_s = 10.0 if options.quick else options.cell_s
    result = measure([*names, *acados], options.n or sizes, ticks, cell_s, options.flights)
    if "rti" in names:
        time_s = 20.0 if options.quick else 60.0
        for label, stronger in (("", 1.0), ("_actuators_5_percent_stronger", 1.05)):
            position_m, angle_deg = tracking(stronger, time_s)
            result[f"tracking{label}_position_rms_m"] = position_m
            result[f"tracking{label}_orientation_rms_deg"] = angle_deg
        result["rti_start_to_first_solve_s"] = start("rti")
    if importlib.util.find_spec("ziglang") is None:
        print(
            "kernels  compilation not measured: ziglang, which the package's build brings along, is not installed"
        )
    else:
        result["kernels_compilation_s"] = compilation()
    for name, value in result.items():
        if re.search("over_|growth|tracking|start|compilation", name):
            print(f"{name}  {value:.5g}")
    write_json(options.json, result)


if __name__ == "__main__":
    main()
