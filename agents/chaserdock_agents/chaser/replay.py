# SPDX-License-Identifier: Apache-2.0
"""Replay the chasers' perception on recorded images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
from chaserdock_protocol import topics
from chaserdock_protocol.replay_node import Published, Stage
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.transport import ReceivedMessage

from .perception import make_perception
from .vision import Vision


def play_perception(
    scenario: FlightScenario, recorded: Iterable[ReceivedMessage]
) -> Iterator[Published]:
    """Return the sightings of all chasers."""
    cv2.setNumThreads(1)
    chasers: dict[int, Vision] = {}
    last_seq: dict[int, int] = {}
    for received in recorded:
        message = received.message
        number, seq = message.chaser, message.seq
        is_sighting = received.topic is topics.SIGHTING
        if received.topic is topics.WRENCH:
            if number in chasers:
                chasers[number].inform(message)
            continue
        if number not in chasers or (is_sighting and seq < last_seq.get(number, -1)):
            chasers[number] = Vision(make_perception(scenario))
        if is_sighting:
            last_seq[number] = seq
        elif (sighting := chasers[number].look(message)) is not None:
            yield topics.SIGHTING, number, sighting


PERCEPTION = Stage("chaser", (topics.IMAGE, topics.WRENCH), (topics.SIGHTING,), play_perception)
