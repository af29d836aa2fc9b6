# SPDX-License-Identifier: Apache-2.0
"""Opens a log: typed messages, and tables by topic.

>>> from chaserdock.logs import open_log  # doctest: +SKIP
>>> log = open_log("runs/main")
>>> for estimate in log.messages(TargetEstimate): print(estimate.position_m)
>>> log.table("controller/target").to_pandas()  # where pandas is installed
"""

# pyarrow has no type stubs.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownParameterType=false
# pyright: reportUnknownVariableType=false

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import (
    LogError,
    LogSource,
    Record,
    count_messages,
    logged_scenario,
    read_log,
)
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.topics import Topic
from msgspec import Struct

if TYPE_CHECKING:
    import pyarrow

MessageT = TypeVar("MessageT", bound=Struct)


def open_log(source: str | Path | Sequence[str | Path]) -> Log:
    """Open a log: a file, the folder of a run, or the files of a rotated log. Raises LogError,
    ScenarioError.
    """
    paths = Path(source) if isinstance(source, str | Path) else [Path(s) for s in source]
    return Log(paths, *logged_scenario(paths))


class Log:
    """A log: its ``scenario``, its ``run`` data (run_id, mode, versions) and its messages. Files
    are read on each call.
    """

    def __init__(self, source: LogSource, scenario: Scenario, run: dict[str, str]) -> None:
        self.source, self.scenario, self.run = source, scenario, run

    @cached_property
    def counts(self) -> dict[str, int]:
        """Number of messages by key."""
        return count_messages(self.source)

    def records(self, *names: str | Topic) -> Iterator[Record]:
        """Iterate over messages with their keys, in file order; over all messages without
        ``names``.

        A name is a topic (``topics.TARGET``), its key in the topics table
        (``"chaser/{chaser}/sighting"``) or a concrete key (``"chaser/0/sighting"``). Raises
        LogError for an unknown name, and where the log is damaged.
        """
        return read_log(self.source, self._keys(names) if names else None)

    @overload
    def messages(self, kind: type[MessageT], /) -> Iterator[MessageT]: ...
    @overload
    def messages(self, *names: str | Topic) -> Iterator[Any]: ...
    def messages(self, *names: Any) -> Iterator[Any]:
        """Iterate over messages of a type (``messages.TargetEstimate``) or, by name, as
        ``records``.
        """
        if len(names) == 1 and isinstance(names[0], type):
            names = tuple(topic for topic in topics.TOPICS if topic.kind is names[0])
            if not names:
                raise LogError("messages(): no topic has messages of this type")
        return (record.message for record in self.records(*names))

    def table(self, name: str | Topic) -> pyarrow.Table:
        """Return a topic as one table of all chasers. Columns: ``chaserdock.logs.tables``. Raises
        LogError.

        ``name``: as in ``records``, or that of a file that ``chaserdock log --export`` writes, such
        as ``"chaser_sighting"`` or, for its solutions, ``"chaser_sighting_solutions"``.
        """
        from .tables import TopicTable, topic_of_table

        exported = topic_of_table(name) if isinstance(name, str) else None
        table = TopicTable(exported or topic_named(name))
        for record in self.records(exported or name):
            table.add(record)
        tables = dict(table.take_all())
        return tables[name] if exported and isinstance(name, str) else tables[table.name]

    def _keys(self, names: tuple[str | Topic, ...]) -> set[str]:
        keys: set[str] = set()
        for name in names:
            topic = topic_named(name)
            if isinstance(name, str) and topic.key != name:
                keys.add(name)
            elif "{chaser}" in topic.key:
                keys |= {topic.key_of(i) for i in range(len(self.scenario.chasers))}
            elif "{process}" in topic.key:
                processes = ["world", "target", *topics.CONTROLLERS, "recorder", "operator"]
                processes += [f"chaser/{i}" for i in range(len(self.scenario.chasers))]
                keys |= {topic.key_of(process) for process in processes}
            else:
                keys.add(topic.key)
        return keys


def topic_named(name: str | Topic) -> Topic:
    """Return the topic of this name: a topic itself, its key in the topics table, or a concrete
    key. Raises LogError.
    """
    if isinstance(name, Topic):
        return name
    for topic in topics.TOPICS:
        if topic.key == name:
            return topic
    found = topics.topic_of_key(name)
    if found is None:
        known = ", ".join(t.key for t in topics.TOPICS)
        raise LogError(f"{name}: no such topic or table; known topics: {known}")
    return found[0]
