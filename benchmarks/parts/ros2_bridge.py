# SPDX-License-Identifier: Apache-2.0
"""Cost of the bridge to ROS 2, in its steps, and what remains per message of ROS 2 beside
serialization.

The messages are those of a golden log; a reader in another session takes what is sent.
Serialization is CDR and, of an image, the decoding of JPEG.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from chaserdock_agents.ros2 import conversion
from chaserdock_agents.ros2.conversion import Converter
from chaserdock_agents.ros2.process import SOURCES
from chaserdock_agents.ros2.rmw_zenoh import RosNode, RosPublisher
from chaserdock_agents.ros2.types import TYPES
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import Image
from chaserdock_protocol.transport.zenoh_network import PlainSession
from common import ROOT, Figures, Group, Options

from chaserdock.launch.launcher import free_port
from chaserdock.logs import open_log

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"


def median_us(call: Callable[[], Any], repetitions: int) -> float:
    """Return the median wall time of a call, microseconds."""
    times = []
    for _ in range(repetitions):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return 1e6 * statistics.median(times)


def cost(options: Options) -> Figures:
    """Time each step of the bridge for one message of each topic of the mission, and for an image
    of 0.9 MB.
    """
    repetitions = 100 if options.quick else 1000
    log = open_log(GOLDEN)
    converter = Converter(log.scenario)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session, reader = PlainSession((), (endpoint,), "router"), PlainSession((endpoint,), (), "peer")
    ros, listener = RosNode(session, 0, "bridge"), RosNode(reader, 0, "reader")
    figures: Figures = {}
    try:
        publishers = {}
        for topic, kind in conversion.topic_types(2).items():
            publishers[topic] = ros.publisher(topic, kind, blocking=True)
            listener.subscribe(topic, kind, lambda message: None)
        time.sleep(0.5)
        for source in SOURCES:
            if source is topics.END:
                continue
            # The last one: with an estimate of the target.
            message: Any = [r.message for r in log.records(source)][-1]
            payload, name = codec.encode(message), source.kind.__name__
            parts = converter.convert(message)
            decode = median_us(lambda p=payload, s=source: codec.decode(s.kind, p), repetitions)
            convert = median_us(lambda m=message: converter.convert(m), repetitions)
            jpeg = 0.0
            if isinstance(message, Image):
                pixels = conversion.image(message).data
                raw = Image(
                    chaser=0,
                    width_px=message.width_px,
                    height_px=message.height_px,
                    encoding="mono8",
                    data=pixels.tobytes(),
                )
                with_raw = median_us(lambda m=raw: converter.convert(m), repetitions)
                jpeg, convert = convert - with_raw, with_raw
            data = [bytes(TYPES.serialize_cdr(part.message, part.type_name)) for part in parts]
            cdr = median_us(
                lambda ps=parts: [TYPES.serialize_cdr(p.message, p.type_name) for p in ps],
                repetitions,
            )
            send = median_us(
                lambda ps=parts, ds=data: [
                    publishers[p.topic].send(d) for p, d in zip(ps, ds, strict=True)
                ],
                repetitions,
            )
            beside = (decode + convert + send) / len(parts)
            figures |= {
                f"{name}_ros_messages": float(len(parts)),
                f"{name}_receive_us": decode,
                f"{name}_convert_us": convert,
                f"{name}_send_us": send,
                f"{name}_serialize_us": cdr + jpeg,
                f"{name}_beside_serialization_us_per_message": beside,
            }
        figures |= large_image(publishers["/chaser_0/image"], repetitions)
        time.sleep(0.5)  # until the reader has taken everything
    finally:
        ros.close()
        listener.close()
    worst = max(v for k, v in figures.items() if k.endswith("_per_message"))
    return {**figures, "worst_beside_serialization_ms_per_message": worst / 1000.0}


def large_image(publisher: RosPublisher, repetitions: int) -> Figures:
    """Time the steps for an image of the default camera's size, 0.9 MB, not compressed."""
    message = Image(
        chaser=0, width_px=1280, height_px=720, encoding="mono8", data=bytes(1280 * 720)
    )
    converted, payload = conversion.image(message), codec.encode(message)

    def serialize() -> bytes:
        return bytes(TYPES.serialize_cdr(converted, "sensor_msgs/msg/Image"))

    cdr = serialize()
    return {
        "large_image_receive_us": median_us(lambda: codec.decode(Image, payload), repetitions),
        "large_image_convert_us": median_us(lambda: conversion.image(message), repetitions),
        "large_image_send_us": median_us(lambda: publisher.send(cdr), repetitions),
        "large_image_serialize_us": median_us(serialize, repetitions),
    }


GROUP = Group({"ros2": cost})
