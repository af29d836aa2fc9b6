# SPDX-License-Identifier: Apache-2.0
"""The simulated physics: ``python benchmarks/physics.py [--only PART ...]``.

The engines PyBullet and MuJoCo against each other, for 30 s (``--quick``: 5 s) in open loop and in
missions, and relative orbital motion against Basilisk.
"""

from common import main
from parts import engines, relative_orbit

GROUPS = (
    engines.GROUP,
    relative_orbit.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
