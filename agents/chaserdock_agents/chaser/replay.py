# SPDX-License-Identifier: Apache-2.0
"""Replay of the chasers' perception on recorded images: the code of their processes on a replay
node.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, cast

import cv2
from chaserdock_protocol import topics
from chaserdock_protocol.replay_node import Published, ReplayNode, SilentHeartbeat, Stage
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.transport import Node, ReceivedMessage

from .process import ChaserProcess


def play_perception(
    scenario: FlightScenario, recorded: Iterable[ReceivedMessage]
) -> Iterator[Published]:
    """Return the sightings of all chasers."""
    cv2.setNumThreads(1)
    chasers: dict[int, tuple[ReplayNode, ChaserProcess]] = {}
    last_seq: dict[int, int] = {}
    for received in recorded:
        number, seq = received.message.chaser, received.message.seq
        is_sighting = received.topic is topics.SIGHTING
        if received.topic is topics.WRENCH:
            if number in chasers:
                chasers[number][1].inform_perception(received.message)
            continue
        if number not in chasers or (is_sighting and seq < last_seq.get(number, -1)):
            node = ReplayNode(f"chaser/{number}")
            chaser = ChaserProcess(cast(Node, node), scenario, number)
            chaser.heartbeat = cast(Any, SilentHeartbeat())
            chasers[number] = node, chaser
        if is_sighting:
            last_seq[number] = seq
            continue
        node, chaser = chasers[number]
        node.put(received)
        chaser.listen()
        yield from (
            published for published in node.take_published() if published[0] is topics.SIGHTING
        )


PERCEPTION = Stage("chaser", (topics.IMAGE, topics.WRENCH), (topics.SIGHTING,), play_perception)
