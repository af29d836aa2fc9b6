# SPDX-License-Identifier: Apache-2.0
"""Explanation of a tick that does not end, and the timer that decides when to give up."""

from __future__ import annotations

from chaserdock_protocol.mission.stall import WaitReport, explain_stall
from chaserdock_protocol.stall import StallTimer

TICK = ("world/tick",)


def test_explanation_follows_the_chain_of_waits_to_the_process_that_hangs() -> None:
    processes = {
        "chaser/0": WaitReport(("controller/chaser/0/wrench",), 0.4),
        "controller": WaitReport(("chaser/1/sighting",), 0.3),
        "chaser/1": WaitReport((), 61.2),
    }
    assert explain_stall({"chaser/0": "chaser/0/actuators"}, "controller", processes) == (
        "chaser/1 owes chaser/1/sighting (hangs or is cut off: silent for 61 s); "
        "chaser/0 owes chaser/0/actuators (waits for controller/chaser/0/wrench); "
        "controller owes controller/chaser/0/wrench (waits for chaser/1/sighting)"
    )


def test_explanation_names_a_message_of_the_world_that_was_lost() -> None:
    processes = {"chaser/0": WaitReport(("world/chaser/0/odometry",), 0.1)}
    assert explain_stall({"chaser/0": "chaser/0/actuators"}, "controller", processes).startswith(
        "world published world/chaser/0/odometry, which was lost on its way; "
    )


def test_explanation_of_circular_waits_ends_and_names_busy_missing_and_idle_processes() -> None:
    circular = {
        "chaser/0": WaitReport(("controller/chaser/0/wrench",), 0.0),
        "standby": WaitReport(("chaser/0/sighting",), 0.0),
    }
    text = explain_stall({"chaser/0": "chaser/0/actuators"}, "standby", circular)
    assert text.count("chaser/0 owes chaser/0/sighting") == 1
    assert "not running" in explain_stall({"recorder": "recorder/ack"}, "", {})
    busy = {"recorder": WaitReport((), 0.0)}
    assert "hangs: alive" in explain_stall({"recorder": "recorder/ack"}, "", busy)
    idle = {"chaser/0": WaitReport(TICK, 0.0)}
    assert "lost on its way" in explain_stall({"chaser/0": "chaser/0/actuators"}, "", idle)


def test_timer_counts_waiting_but_not_a_time_in_which_the_process_was_frozen() -> None:
    now_s = 0.0
    timer = StallTimer(lambda: now_s)
    for time_s in (0.2, 0.4, 3600.0):
        now_s = time_s
        timer.update()
    assert timer.waited_s == 0.4 + 0.5
    timer.reset()
    assert timer.waited_s == 0.0
