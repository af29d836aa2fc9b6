# SPDX-License-Identifier: Apache-2.0
"""A short mission's messages, and how to put them into a log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.recording.log import LogWriter

V, Q = (0.25, -1.5, 3.0), (0.5, -0.5, 0.5, -0.5)
SCENARIO = '{"format": 3, "name": "a scenario"}'


class Clock:
    """A wall clock set by the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def flight(ticks: int) -> Iterator[tuple[topics.Topic, int | str | None, m.Message]]:
    """Return the messages of a short mission with two chasers."""
    for k in range(ticks):
        head: dict[str, Any] = {"seq": k, "tick": k, "sim_time_ns": k * 66_666_666}
        yield (
            topics.TICK,
            None,
            m.Tick(**head, images=True, chasers=(0, 1), controllers={"controller": "c"}),
        )
        for i in (0, 1):
            state = {
                "position_m": (float(k), float(i), 0.5),
                "velocity_m_s": V,
                "q_wxyz": Q,
                "omega_rad_s": V,
            }
            yield topics.ODOMETRY, i, m.Odometry(**head, chaser=i, **state)
            yield topics.TRUTH_BODY, f"chaser/{i}", m.BodyTruth(**head, body=f"chaser/{i}", **state)
        image = bytes((k * 7 + j * j) % 251 for j in range(64))
        yield (
            topics.IMAGE,
            1,
            m.Image(**head, chaser=1, width_px=8, height_px=8, encoding="mono8", data=image),
        )


def record(
    writer: LogWriter, topic: topics.Topic, place: int | str | None, message: m.Message, sent: int
) -> None:
    writer.write(topic.key_of(place), m.encoding_of(topic.kind), codec.encode(message), sent)
