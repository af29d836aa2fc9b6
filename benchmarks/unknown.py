# SPDX-License-Identifier: Apache-2.0
"""A target of unknown shape: map and motion from what two chasers see.

``python benchmarks/unknown.py [--suns NAME ...] [--rates-deg-s RATE ...] [--flights N]
[--results FILE]``
"""

from common import main
from parts import unknown_colmap, unknown_map

GROUPS = (unknown_map.GROUP, unknown_colmap.GROUP)

if __name__ == "__main__":
    main(__doc__, GROUPS)
