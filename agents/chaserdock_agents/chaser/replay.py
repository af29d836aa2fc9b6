"""The chasers' perception again, on recorded images: their processes' own code, with a tape for a network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, cast

import cv2
from chaserdock_protocol import topics
from chaserdock_protocol.replay_node import Published, ReplayNode, SilentHeartbeat, Stage
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.transport import Node, ReceivedMessage

from .process import Chaser


def play_perception(scenario: Scenario, recorded: Iterable[ReceivedMessage]) -> Iterator[Published]:
    """The sightings of all chasers."""
    cv2.setNumThreads(1)
    chasers: dict[int, tuple[ReplayNode, Chaser]] = {}
    last_seq: dict[int, int] = {}
    for received in recorded:
        number, seq = received.message.chaser, received.message.seq
        answers = received.topic is topics.SIGHTING
        if number not in chasers or (answers and seq < last_seq.get(number, -1)):
            tape = ReplayNode(f"chaser/{number}")
            chaser = Chaser(cast(Node, tape), scenario, number)
            chaser.heartbeat = cast(Any, SilentHeartbeat())
            chasers[number] = tape, chaser
        if answers:
            last_seq[number] = seq
            continue
        tape, chaser = chasers[number]
        tape.put(received)
        chaser.listen()
        yield from (said for said in tape.take_published() if said[0] is topics.SIGHTING)


PERCEPTION = Stage("chaser", (topics.IMAGE,), (topics.SIGHTING,), play_perception)
