# SPDX-License-Identifier: Apache-2.0
"""Message types of ROS 2 Jazzy, which Kilted shares: serialization (CDR) and type hashes.

The hash (REP 2016, RIHS01) of a type is part of its keys on the network.
"""

from __future__ import annotations

from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
"""Types by name, such as ``nav_msgs/msg/Odometry``."""
