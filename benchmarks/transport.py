# SPDX-License-Identifier: Apache-2.0
"""Processes, network and faults: ``python benchmarks/transport.py [--only PART ...]``.

Latency in real time, take-over by the standby controller, random faults, failures of containers,
and the bridge to ROS 2. Measures wall time: run nothing else beside it.
"""

from common import main
from parts import containers, faults, realtime, ros2_bridge, standby

GROUPS = (
    realtime.GROUP,
    standby.GROUP,
    faults.GROUP,
    containers.GROUP,
    ros2_bridge.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
