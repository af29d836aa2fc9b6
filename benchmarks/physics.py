# SPDX-License-Identifier: Apache-2.0
"""The simulated physics: ``python benchmarks/physics.py [--only PART ...]``.

The engines PyBullet and MuJoCo against each other, for 30 s (``--quick``: 5 s) in open loop and in
missions, relative orbital motion and bodies that are not rigid against Basilisk, and the speed of
the training environments, also beside other simulators.
"""

from common import main
from parts import engines, environments, flexible, peer_environments, relative_orbit

GROUPS = (
    engines.GROUP,
    relative_orbit.GROUP,
    flexible.GROUP,
    environments.GROUP,
    peer_environments.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
