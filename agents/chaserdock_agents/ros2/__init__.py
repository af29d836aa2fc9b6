# SPDX-License-Identifier: Apache-2.0
"""Bridge to ROS 2. Needs the extra ``chaserdock[ros2]``."""

from chaserdock_protocol.errors import require_extra

require_extra("rosbags", "ros2")
