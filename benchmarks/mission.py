# SPDX-License-Identifier: Apache-2.0
"""Missions in separate processes: ``python benchmarks/mission.py [--only PART ...]``.

Speed and accuracy of the main mission, its cost beside that of another commit, cost of a tick by
number of chasers, memory over a simulated day, and commands that read logs. Measures wall time: run
nothing else beside it.
"""

from common import main
from parts import against, endurance, long_logs, mission_speed, scale, swarm

GROUPS = (
    mission_speed.GROUP,
    against.GROUP,
    scale.GROUP,
    swarm.GROUP,
    long_logs.GROUP,
    endurance.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
