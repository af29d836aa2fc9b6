# SPDX-License-Identifier: Apache-2.0
"""Estimation of the target: ``python benchmarks/estimation.py [--only PART ...]``.

Flights with rendered images in one process, camera errors and their observability, the default
estimator against the paper's under sensor errors, and against itself with more than 16 chasers.
"""

from common import main
from parts import covariance_forms, estimation_flights, observability, robustness

GROUPS = (
    estimation_flights.GROUP,
    observability.GROUP,
    robustness.GROUP,
    covariance_forms.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
