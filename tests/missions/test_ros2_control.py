# SPDX-License-Identifier: Apache-2.0
"""A node of ROS 2 in place of the controller: odometry in, wrenches out, in real time, both by
zenoh-ros2-sdk.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.ros2.types import TYPES, type_hash
from chaserdock_models import rotations
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT, ByHand, free_port, sets
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

from chaserdock.analysis.flight import load_flight

ODOMETRY, WRENCH = "nav_msgs/msg/Odometry", "geometry_msgs/msg/WrenchStamped"
SCENARIO = ROOT / "scenarios" / "single.toml"
OVERRIDES = ("duration_s=14.0", 'perception.name="statistical"', 'navigation.grade="exact"')


def xyz(v: Any) -> np.ndarray[Any, Any]:
    return np.array([v.x, v.y, v.z])


@pytest.mark.slow
def test_node_of_ros_flies_a_chaser_to_a_point(tmp_path: Path) -> None:
    """A PD law for 0.2 m along WRF's x from the start, at rest and without rotation; judged by the
    true state.
    """
    body = load_scenario(SCENARIO).chaser
    hand, ros_port, flown = ByHand.at_free_port("ros-control"), free_port(), tmp_path / "run"
    ros = f"tcp/127.0.0.1:{ros_port}"
    start: list[np.ndarray[Any, Any]] = []

    def control(odometry: Any) -> None:
        position, q = xyz(odometry.pose.pose.position), odometry.pose.pose.orientation
        q_wxyz = np.array([q.w, q.x, q.y, q.z])
        start.append(position)
        to_go = rotations.rotate_inverse(q_wxyz, start[0] + [0.2, 0.0, 0.0] - position)
        rate = xyz(odometry.twist.twist.angular)
        force = body.mass_kg * (0.5 * to_go - 1.2 * xyz(odometry.twist.twist.linear))
        torque = -1.2 * np.array(body.inertia) * rate
        store = publisher.session_mgr.store.types
        vector = store["geometry_msgs/msg/Vector3"]
        publisher.publish(
            header=store["std_msgs/msg/Header"](odometry.header.stamp, "chaser_0"),
            wrench=store["geometry_msgs/msg/Wrench"](
                vector(*np.clip(force, -body.force_max_N, body.force_max_N).tolist()),
                vector(*np.clip(torque, -body.torque_max_N_m, body.torque_max_N_m).tolist()),
            ),
        )

    try:
        hand.start("bridge", "ros2", "--ros-listen", ros)
        hand.start("control", "ros2", "--control", "--ros-connect", ros)
        hand.start("chaser", "chaser", "0")
        hand.start("recorder", "record", "--out", str(flown))
        where: dict[str, Any] = {"router_port": ros_port}
        publisher = ROS2Publisher(
            "/chaser_0/wrench_command",
            WRENCH,
            TYPES.generate_msgdef(WRENCH, ros_version=2)[0],
            type_hash=type_hash(WRENCH),
            **where,
        )
        ROS2Subscriber(
            "/chaser_0/odometry",
            ODOMETRY,
            control,
            TYPES.generate_msgdef(ODOMETRY, ros_version=2)[0],
            type_hash=type_hash(ODOMETRY),
            **where,
        )
        hand.start("world", "world", str(SCENARIO), "--mode", "realtime", *sets(*OVERRIDES))
        status, said = hand.output_of("world", timeout_s=120)
        assert status == 0, said
        assert hand.output_of("control")[0] == 0
        assert hand.output_of("bridge")[0] == 0
        assert hand.output_of("recorder")[0] == 0
    finally:
        ZenohSession.get_instance("127.0.0.1", ros_port).close()
        hand.end()
    truth = load_flight(flown / "mission.mcap").motion["chaser/0"]
    assert len(start) > 100
    moved = truth.position_m[-1] - truth.position_m[0]
    assert np.linalg.norm(moved - [0.2, 0.0, 0.0]) < 0.02
