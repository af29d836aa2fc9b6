"""A log for people's own programs: typed messages and tables by topic.

>>> from chaserdock.logs import open_log                                                # doctest: +SKIP
>>> log = open_log(Path("runs/main"))
>>> for estimate in log.messages("controller/target"): print(estimate.position_m)
>>> log.table("controller/target").to_pandas()                                  # where pandas is installed
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import (
    LogError,
    LogSource,
    Record,
    count_messages,
    read_log,
    read_scenario,
)
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.topics import Topic

if TYPE_CHECKING:
    import pyarrow


def open_log(source: LogSource) -> Log:
    """The log in a file, a run's folder, or several files of one run; raises LogError, or ScenarioError for its scenario."""
    text, run = read_scenario(source)
    return Log(source, scenario_from_json(text, f"{source}: scenario"), run)


class Log:
    """A log: its ``scenario``, its ``run`` data (run_id, mode, versions), its messages. Nothing is kept in memory."""

    def __init__(self, source: LogSource, scenario: Scenario, run: dict[str, str]) -> None:
        self.source, self.scenario, self.run = source, scenario, run

    @cached_property
    def counts(self) -> dict[str, int]:
        """Messages by key."""
        return count_messages(self.source)

    def records(self, *names: str | Topic) -> Iterator[Record]:
        """Messages with their keys, in file order: of topics (``topics.TARGET``), of their keys as the topics table has
        them (``"chaser/{chaser}/sighting"``) or of concrete keys (``"chaser/0/sighting"``); of all without names.

        Raises LogError for a name that is no topic, and where the log is damaged.
        """
        return read_log(self.source, self._keys(names) if names else None)

    def messages(self, *names: str | Topic) -> Iterator[Any]:
        """As ``records``, the messages alone."""
        return (record.message for record in self.records(*names))

    def table(self, name: str | Topic) -> pyarrow.Table:
        """One tidy table of a topic, all chasers together; columns as in ``tables``. Raises LogError."""
        from .tables import TopicTable

        topic = topic_named(name)
        table = TopicTable(topic)
        for record in self.records(name):
            table.add(record)
        return table.take()

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
    """A topic by itself, by its key in the topics table, or by a concrete key; raises LogError."""
    if isinstance(name, Topic):
        return name
    for topic in topics.TOPICS:
        if topic.key == name:
            return topic
    found = topics.topic_of_key(name)
    if found is None:
        raise LogError(f"{name}: no such topic; known: {', '.join(t.key for t in topics.TOPICS)}")
    return found[0]
