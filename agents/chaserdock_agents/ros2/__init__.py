# SPDX-License-Identifier: Apache-2.0
"""Bridge to ROS 2. Needs the extra ``chaserdock[ros2]``."""
