# SPDX-License-Identifier: Apache-2.0
"""Rendezvous from far range: ``python benchmarks/rendezvous.py [--only PART ...]``.

Whole flights along V-bar and R-bar, passively safe aborts, and published tasks.
"""

from common import main
from parts import published_tasks, rendezvous_flights

GROUPS = (
    rendezvous_flights.GROUP,
    published_tasks.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
