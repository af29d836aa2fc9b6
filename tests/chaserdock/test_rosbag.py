# SPDX-License-Identifier: Apache-2.0
"""A log as a bag of ROS 2, read by rosbags and by mcap-ros2-support."""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.ros2.conversion import Converter
from chaserdock_protocol import topics
from chaserdock_protocol.errors import MissingPackageError
from chaserdock_protocol.recording.log import LogError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from chaserdock.logs import open_log
from chaserdock.logs.rosbag import export_bag

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"
Stored = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int]]:
    folder = tmp_path_factory.mktemp("bags") / "flight"
    return folder, export_bag(GOLDEN, folder, images=True)


def plain(value: Any) -> Any:
    """Return a message of either reader as nested lists and dictionaries, without constants."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes | memoryview):
        return list(value)
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    names = getattr(value, "__dataclass_fields__", None) or getattr(value, "__slots__", None)
    if names is None:
        return value
    return {
        name: plain(getattr(value, name))
        for name in names
        if not name.startswith("_") and not name.isupper()
    }


def expected() -> Stored:
    log = open_log(GOLDEN)
    converter = Converter(log.scenario)
    found: Stored = defaultdict(list)
    for record in log.records():
        for part in converter.convert(record.message):
            found[part.topic].append((part.time_ns, plain(part.message)))
    return found


def test_rosbags_reads_it_back_equal(bag: tuple[Path, dict[str, int]]) -> None:
    read: Stored = defaultdict(list)
    with AnyReader([bag[0]]) as reader:
        for connection, time_ns, data in reader.messages():
            read[connection.topic].append(
                (time_ns, plain(reader.deserialize(data, connection.msgtype)))
            )
    whole = expected()
    assert Counter({topic: len(items) for topic, items in whole.items()}) == bag[1]
    for topic, items in whole.items():
        assert read[topic] == sorted(items, key=lambda item: item[0]), topic


def test_mcap_ros2_support_reads_it_back_equal(bag: tuple[Path, dict[str, int]]) -> None:
    read: Stored = defaultdict(list)
    (path,) = bag[0].glob("*.mcap")
    with path.open("rb") as file:
        for _, channel, message, ros in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            read[channel.topic].append((message.log_time, plain(ros)))
    for topic, items in expected().items():
        assert read[topic] == sorted(items, key=lambda item: item[0]), topic


def test_images_are_those_of_the_log_and_optional(
    tmp_path: Path, bag: tuple[Path, dict[str, int]]
) -> None:
    assert bag[1]["/chaser_0/image"] == sum(
        r.topic is topics.IMAGE and r.place == "0" for r in open_log(GOLDEN).records()
    )
    without = export_bag(GOLDEN, tmp_path / "bag")
    assert without == {
        t: n for t, n in bag[1].items() if not t.endswith(("/image", "/camera_info"))
    }


def test_existing_folder_and_missing_extra_are_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(LogError, match="already exists; export into a new folder"):
        export_bag(GOLDEN, tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(
        MissingPackageError, match=r"rosbags, of the extra chaserdock\[ros2\], is not installed"
    ):
        export_bag(GOLDEN, tmp_path / "new")
