# SPDX-License-Identifier: Apache-2.0
"""Estimation of the target: ``python benchmarks/estimation.py [--only PART ...]``.

Flights with rendered images in one process, camera errors and their observability, and the default
estimator against the paper's under sensor errors.
"""

from common import main
from parts import estimation_flights, observability, robustness

GROUPS = (
    estimation_flights.GROUP,
    observability.GROUP,
    robustness.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
