# SPDX-License-Identifier: Apache-2.0
"""Interfaces between a ``Node`` and what carries its messages: Zenoh between processes, or a
simulated network.

A ``Network`` opens one ``Connection`` per node, and gives the ``Host`` that its process runs on:
time, waiting, queues between threads, unique names, and the process' own end. Processes use no
other clock and wait nowhere else, so that they run unchanged in virtual time.
"""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from msgspec import Struct

from .bounded_queue import BoundedQueue

T = TypeVar("T", bound=Struct)
Undo = Callable[[], None]
"""Function that ends what the call that returned it has begun."""


class Host(Protocol):
    """What a process needs of the machine that it runs on."""

    def now_s(self) -> float:
        """Return the monotonic clock (s)."""
        ...

    def sleep(self, duration_s: float) -> None: ...

    def new_queue(self) -> BoundedQueue[Any]:
        """Return a queue from the network's threads to that of the process."""
        ...

    def unique_id(self) -> str:
        """Return 12 hexadecimal digits that differ from all others."""
        ...

    def repeat(self, call: Callable[[], float]) -> Undo:
        """Call ``call`` in the background, now and each time after the seconds that it returned."""
        ...

    def worker(self, call: Callable[[Any], None]) -> tuple[Callable[[Any], None], Undo]:
        """Return a function that has ``call`` handle an item in the background, one at a time, and
        one that ends this.

        An item replaces one that still waits. What ``call`` raises, the next item raises.
        """
        ...

    def finish_startup(self) -> None:
        """Tell the host that the process has created its long-lived objects."""
        ...

    def lower_priority(self) -> None:
        """Give the processor to other processes first."""
        ...

    def kill(self) -> None:
        """End this process without any clean-up."""
        ...

    def freeze(self, duration_s: float) -> None:
        """Stop all threads of this process for a time (s)."""
        ...


class RawSample(Struct, frozen=True):
    """A sample from the wire, not decoded. ``source``: session that stamped it, which is its
    publisher's (see ``Connection``).
    """

    key: str
    encoding: str
    payload: bytes
    sent_ns: int
    source: str = ""


class Query(Protocol):
    """A query that has arrived."""

    @property
    def payload(self) -> bytes: ...
    @property
    def encoding(self) -> str: ...

    def reply(self, payload: bytes, encoding: str) -> None:
        """Answer the query, once, from any thread."""
        ...

    def refuse(self, text: str) -> None:
        """Answer the query with an error, once."""
        ...


@dataclass(frozen=True)
class Reply:
    """One reply to a query; ``error``: the text of a refusal, else empty."""

    payload: bytes
    encoding: str
    error: str = ""


class Connection(Protocol):
    """One node's access to the network. Callbacks run on threads of the network and must not
    block.
    """

    @property
    def source(self) -> str:
        """Identity of this session, the ``source`` of the samples that it publishes."""
        ...

    def declare_publisher(
        self, key: str, encoding: str, qos: str, *, express: bool, blocking: bool
    ) -> Callable[[bytes], None]:
        """Declare a publisher and return the function that sends a payload.

        ``blocking``: a slow reader blocks the publisher, else it misses messages. ``express``: not
        batched.
        """
        ...

    def put(self, raw: RawSample) -> None:
        """Send a payload on any key."""
        ...

    def decode(self, kind: type[T], raw: RawSample) -> T:
        """Decode and validate a sample; raises Rejected as ``codec.decode`` does."""
        ...

    def subscribe(self, expression: str, arrived: Callable[[RawSample], None]) -> None: ...

    def subscribe_ring(self, expression: str, depth: int) -> Callable[[], RawSample | None]:
        """Keep the newest ``depth`` samples; return the function that takes the oldest of them, if
        any.
        """
        ...

    def declare_queryable(self, key: str, arrived: Callable[[Query], None]) -> Undo: ...

    def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float
    ) -> Iterable[Reply]: ...

    def declare_liveliness(self, key: str) -> None: ...

    def watch_liveliness(self, expression: str, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(key, alive)`` for each liveliness token that exists, appears or
        disappears.
        """
        ...

    def close(self) -> None:
        """Send all published messages, then leave the network."""
        ...


class Network(Protocol):
    """Opens connections."""

    def open(self, name: str) -> tuple[Connection, Host]:
        """Connect process ``name``. Raises TransportError."""
        ...


def unique_id() -> str:
    """Return 12 hexadecimal digits that differ from all others."""
    return uuid.uuid4().hex[:12]


class Machine:
    """The ``Host`` of a process of the operating system."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def new_queue(self) -> BoundedQueue[Any]:
        return BoundedQueue()

    def unique_id(self) -> str:
        return unique_id()

    def repeat(self, call: Callable[[], float]) -> Undo:
        """Call ``call`` from a daemon thread; the returned function joins it."""
        stop = threading.Event()

        def run() -> None:
            while not stop.is_set():
                stop.wait(call())

        thread = threading.Thread(target=run, name="repeat", daemon=True)
        thread.start()

        def end() -> None:
            stop.set()
            thread.join()

        return end

    def worker(self, call: Callable[[Any], None]) -> tuple[Callable[[Any], None], Undo]:
        """Call ``call`` from a daemon thread; the end joins it."""
        waiting: deque[Any] = deque(maxlen=1)
        ready, stop = threading.Event(), threading.Event()
        errors: list[BaseException] = []

        def run() -> None:
            try:
                while not stop.is_set():
                    ready.wait()
                    ready.clear()
                    while waiting and not stop.is_set():
                        call(waiting.popleft())
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=run, name="worker", daemon=True)
        thread.start()

        def put(item: Any) -> None:
            if errors:
                raise errors[0]
            waiting.append(item)
            ready.set()

        def end() -> None:
            stop.set()
            ready.set()
            thread.join()

        return put, end

    def finish_startup(self) -> None:
        """Exclude the objects created so far from garbage collection.

        It would otherwise pause the flight for some 10 ms.
        """
        gc.collect()
        gc.freeze()

    def lower_priority(self) -> None:
        os.nice(19)

    def kill(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def freeze(self, duration_s: float) -> None:
        """Stop this process (SIGSTOP) for a wall-clock duration. A detached shell sends SIGCONT."""
        command = ["/bin/sh", "-c", f'sleep {duration_s:.3f}; kill -CONT "$0"', str(os.getpid())]
        null = subprocess.DEVNULL
        subprocess.Popen(command, stdin=null, stdout=null, stderr=null, start_new_session=True)
        os.kill(os.getpid(), signal.SIGSTOP)
