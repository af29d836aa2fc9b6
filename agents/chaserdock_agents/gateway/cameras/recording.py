# SPDX-License-Identifier: Apache-2.0
"""Image topics of recordings: MCAP files, a mission's log among them, and bags of ROS 2."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from chaserdock_protocol.errors import require_extra
from chaserdock_protocol.recording.scan import errors_of_parsing, parse_record, records
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from .image_messages import DECODERS, ROS_TYPES, BadImageMessage, decode_image_message
from .source import Captured, CapturedImage, ImageSourceError, OpeningOptions, UnreadableImage


class _Stored(NamedTuple):
    """A message of the topic: what `decode_image_message` takes."""

    schema: str
    data: bytes
    encoding: str
    about: dict[str, str]


def open_recording(address: str, options: OpeningOptions) -> RecordedTopic:
    """Open an image topic of an MCAP file, or of a folder with MCAP files or a bag of ROS 2."""
    path = Path(address)
    if not path.exists():
        raise ImageSourceError(f"{address}: no such recording")
    if path.suffix == ".db3":
        path = path.parent
    return BagTopic(path, options) if (path / "metadata.yaml").is_file() else McapTopic(
        path, options
    )  # fmt: skip


class RecordedTopic(ABC):
    """Delivers the images of a topic in the order of the recording, with the times of their
    exposure.
    """

    live = False

    def __init__(self, path: Path, topics: dict[str, str], options: OpeningOptions) -> None:
        """``topics``: name of the schema of each topic."""
        self._path = path
        self.topic = _chosen(path, topics, options.topic)
        self.name = f"{path} {self.topic}"
        if topics[self.topic] in ROS_TYPES:
            require_extra("rosbags", "ros2")

    def frames(self) -> Iterator[Captured]:
        """Yield the images in order. Raises ImageSourceError for a damaged recording."""
        for sequence, stored in enumerate(self._stored()):
            try:
                pixels, time_ns = decode_image_message(*stored)
            except BadImageMessage as error:
                yield UnreadableImage(sequence, f"image {sequence} of {self.topic}: {error}")
                continue
            yield CapturedImage(pixels, time_ns, "exposure", None, sequence)

    def close(self) -> None:  # noqa: B027  (no kind of recording holds a file open)
        """Do nothing: files are closed with the last image."""

    @abstractmethod
    def _stored(self) -> Iterator[_Stored]:
        """Yield the messages of the topic in order."""


class McapTopic(RecordedTopic):
    """A topic of MCAP files. Files are read to their last whole message, as those of our logs."""

    def __init__(self, path: Path, options: OpeningOptions) -> None:
        self._files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        topics: dict[str, str] = {}
        for file in self._files:
            topics |= _topics_of(file)
        super().__init__(path, topics, options)

    def _stored(self) -> Iterator[_Stored]:
        for file in self._files:
            schemas, channels = dict[int, str](), dict[int, Channel]()
            for record in _parsed(file):
                match record:
                    case Schema():
                        schemas[record.id] = record.name
                    case Channel() if record.topic == self.topic:
                        channels[record.id] = record
                    case McapMessage() if record.channel_id in channels:
                        of = channels[record.channel_id]
                        yield _Stored(
                            schemas.get(of.schema_id, ""),
                            record.data,
                            of.message_encoding,
                            of.metadata,
                        )


def _parsed(file: Path) -> Iterator[Any]:
    for opcode, content in records(file):
        with errors_of_parsing(file):
            inside = list(parse_record(opcode, content))
        yield from inside


def _topics_of(file: Path) -> dict[str, str]:
    """Return the topics of a file with their schemas, by its summary or else by all of it."""
    with suppress(McapError, OSError, ValueError), file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        if summary is not None and summary.channels:
            names = {key: schema.name for key, schema in summary.schemas.items()}
            return {c.topic: names.get(c.schema_id, "") for c in summary.channels.values()}
    schemas, topics = dict[int, str](), dict[str, str]()
    for record in _parsed(file):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            topics[record.topic] = schemas.get(record.schema_id, "")
    return topics


class BagTopic(RecordedTopic):
    """A topic of a bag of ROS 2, with either storage. Needs the extra ``chaserdock[ros2]``."""

    def __init__(self, path: Path, options: OpeningOptions) -> None:
        require_extra("rosbags", "ros2")
        with self._reader(path) as reader:
            topics = {c.topic: c.msgtype for c in reader.connections}
        super().__init__(path, topics, options)

    def _stored(self) -> Iterator[_Stored]:
        from rosbags.rosbag2 import ReaderError

        try:
            with self._reader(self._path) as reader:
                wanted = [c for c in reader.connections if c.topic == self.topic]
                for connection, _, data in reader.messages(wanted):
                    yield _Stored(connection.msgtype, bytes(data), "cdr", {})
        except ReaderError as error:
            raise ImageSourceError(f"{self._path}: damaged: {error}") from None

    @staticmethod
    def _reader(path: Path) -> Any:
        from rosbags.rosbag2 import Reader, ReaderError

        try:
            reader = Reader(path)
            reader.open()
            reader.close()
            return Reader(path)
        except (ReaderError, OSError) as error:
            raise ImageSourceError(f"{path}: is not a bag of ROS 2: {error}") from None


def _chosen(path: Path, topics: dict[str, str], wanted: str | None) -> str:
    """Return the wanted topic, or the only one with images. Raises ImageSourceError."""
    images = sorted(topic for topic, schema in topics.items() if schema in DECODERS)
    listed = ", ".join(images) or "no topic with images of a known type"
    if wanted is None:
        if len(images) == 1:
            return images[0]
        which = "has several image topics; give --topic with one of" if images else "has"
        raise ImageSourceError(f"{path}: {which} {listed}")
    if wanted in images:
        return wanted
    if wanted in topics:
        raise ImageSourceError(
            f"{path}: topic {wanted} has {topics[wanted] or 'unknown messages'}, no images; "
            f"images: {listed}"
        )
    raise ImageSourceError(f"{path}: has no topic {wanted}; images: {listed}")
