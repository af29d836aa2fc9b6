# SPDX-License-Identifier: Apache-2.0
"""The controller in closed loop and the thrusters: ``python benchmarks/control.py [--only PART
...]``.

Avoidance, swaps, clutter and tracking in one process; the cost of distances and of orbital motion
in the plan; allocation, pulses and failures of thrusters; other rates of ticks and carriers;
assurance of commands. `benchmarks/nmpc.py` times the solver.
"""

from common import main
from parts import assurance, closed_loop, orbit_solve, rates, shape_distance, thrusters

GROUPS = (
    closed_loop.GROUP,
    shape_distance.GROUP,
    orbit_solve.GROUP,
    thrusters.GROUP,
    rates.GROUP,
    assurance.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
