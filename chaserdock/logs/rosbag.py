# SPDX-License-Identifier: Apache-2.0
"""Writes a log as a ROS 2 bag (rosbag2 with MCAP storage): ROS 2 schemas and CDR,
``metadata.yaml``.

Topics are those of the bridge, plus the true states of the bodies under ``/truth/`` and the
measured ones under ``/reference/``. Requires the extra ``chaserdock[ros2]``.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from chaserdock_protocol import topics
from chaserdock_protocol.errors import errors_of_writing, require_extra
from chaserdock_protocol.recording.log import LogError, LogSource

from .reader import open_log

BAG_VERSION = 9
"""Version of the metadata format: that of ROS 2 Jazzy and later."""


def export_bag(log: LogSource, folder: Path, images: bool = False) -> dict[str, int]:
    """Write a log as the bag ``folder``, which must not exist. Returns the number of messages by
    topic.

    ``images``: include images (decoded) and camera calibrations. The time of a message is its
    simulated time, of an image its exposure. Like the log, the bag is in order of arrival. Raises
    LogError if the log or the bag cannot be used, MissingPackageError without rosbags.
    """
    require_extra("rosbags", "ros2")
    from chaserdock_agents.ros2.conversion import Converter, InvalidImage
    from chaserdock_agents.ros2.types import TYPES
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer, WriterError
    from rosbags.rosbag2.enums import CompressionFormat

    opened = open_log(log)
    converter = Converter(opened.scenario)
    connections: dict[str, Connection] = {}
    rows: Counter[str] = Counter()
    try:
        with errors_of_writing(folder, LogError):
            writer = Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                for record in opened.records():
                    if record.topic is topics.IMAGE and not images:
                        continue
                    try:
                        converted = converter.convert(record.message)
                    except InvalidImage as error:
                        raise LogError(
                            f"{record.key}, tick {record.message.tick}: {error}"
                        ) from None
                    for ros in converted:
                        if ros.topic not in connections:
                            connections[ros.topic] = writer.add_connection(
                                ros.topic, ros.type_name, typestore=TYPES
                            )
                        data = TYPES.serialize_cdr(ros.message, ros.type_name)
                        writer.write(connections[ros.topic], ros.time_ns, data)
                        rows[ros.topic] += 1
    except WriterError:
        raise LogError(f"{folder}: already exists; export into a new folder") from None
    return dict(sorted(rows.items()))
