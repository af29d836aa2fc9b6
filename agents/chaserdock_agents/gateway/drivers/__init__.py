# SPDX-License-Identifier: Apache-2.0
"""Drivers of the devices that come with chaserdock: ROS 2, PX4 and MAVLink.

Sources of poses state their native axes: ``world_axes`` (``enu``: x east, z up; ``ned``: x north, z
down) and ``body_axes`` (``flu``: x forward, z up; ``frd``: x forward, z down). Robots state
``body_axes``, and how many thrusters (``thrusters``, 0 for one that takes wrenches) they have.
"""
