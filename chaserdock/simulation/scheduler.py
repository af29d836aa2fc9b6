# SPDX-License-Identifier: Apache-2.0
"""Cooperative scheduler in virtual time: tasks run one at a time and hand over only where they
wait.

A task is a greenlet. It runs until it waits for a time or an item. The scheduler then advances
virtual time to the next event and continues the task that this wakes. Events at equal times come in
an order drawn from the seed. A seed therefore repeats a run exactly, and seeds differ in their
interleavings.
"""

from __future__ import annotations

import heapq
import math
import queue
import random
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from greenlet import GreenletExit, getcurrent, greenlet


class Killed(BaseException):
    """Ends a task from within, as SIGKILL ends a process."""


Due = tuple[float, float]
"""Virtual time (s) of an event, and its rank among those of the same time."""
NEVER: Due = (0.0, 0.0)
"""A time before all events."""
SPREAD, WAKE_SPREAD = 32.0, 128.0
"""How many later events of the same time may precede an event, and precede the continuation of a
woken task.
"""
MOST_EVENTS = 1_000_000
"""Most events at one virtual time without progress. A tick has a few hundred, with a flood
100,000.
"""


class Task:
    """One task. ``result``: its return value. ``error``: traceback of the exception that ended it,
    or empty.

    ``until_s``: virtual time (s) at which a pause ends, None without a limit. ``timer_s``: time of
    its pending timer.
    """

    def __init__(self, name: str, work: Callable[[], Any]) -> None:
        self.name = name
        self.done = False
        self.killed = False
        self.result: Any = None
        self.error = ""
        self.waits = 0
        self.until_s: float | None = None
        self.timer_s = math.inf
        self._work = work
        self.fiber = greenlet(self._run)

    def _run(self) -> None:
        try:
            self.result = self._work()
        except Killed:
            self.killed = True
        except Exception:
            self.error = traceback.format_exc()
        finally:
            self.done = True


class Scheduler:
    """Runs tasks and timed calls. ``now_s``: virtual time, from 0. Use from one thread only."""

    def __init__(self, seed: int) -> None:
        self.now_s = 0.0
        self.tasks: list[Task] = []
        self._draw = random.Random(f"scheduler {seed}").random
        self._events: list[tuple[float, float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = self._alive = 0
        self._last_event = MOST_EVENTS
        self._hub: greenlet = getcurrent()
        self._running: Task | None = None

    def call_at(
        self,
        time_s: float,
        call: Callable[..., object],
        after: Due = NEVER,
        args: tuple[Any, ...] = (),
    ) -> Due:
        """Schedule ``call(*args)`` at a virtual time (s), or at once if that has passed, but not
        before the event ``after``. Returns when it comes. The call must not wait.
        """
        self._count += 1
        now_s = self.now_s
        due = (time_s if time_s > now_s else now_s, self._count + SPREAD * self._draw())
        if after > due:
            due = after
        heapq.heappush(self._events, (due[0], due[1], self._count, call, args))
        return due

    def spawn(self, name: str, work: Callable[[], Any]) -> Task:
        """Start a task at the present time."""
        task = Task(name, work)
        self.tasks.append(task)
        self._alive += 1
        self.call_at(self.now_s, self._continue, args=(task, 0))
        return task

    def run(self, limit_s: float, over: Callable[[], bool] | None = None) -> bool:
        """Run until all tasks have ended. Returns False if they have not by ``limit_s`` or when
        ``over`` holds.

        It also returns False after ``MOST_EVENTS`` events at one time without ``note_progress``,
        which would go on forever.
        """
        self._hub = getcurrent()
        self.note_progress()
        events = self._events
        while self._alive:
            if not events or events[0][0] > limit_s or (over is not None and over()):
                return False
            time_s, _, _, call, args = heapq.heappop(events)
            if time_s != self.now_s:
                self.now_s = time_s
                self.note_progress()
            elif self._count > self._last_event:
                return False
            call(*args)
        return True

    def note_progress(self) -> None:
        """Record that events at the present time make progress. Without latency, a lock-step flight
        has a single time.
        """
        self._last_event = self._count + MOST_EVENTS

    def end(self) -> None:
        """End all tasks where they wait."""
        for task in self.tasks:
            if not task.done and task.fiber:
                task.fiber.throw(GreenletExit)
            task.done = True
        self._events.clear()

    # -- for tasks ---------------------------------------------------------------------------------

    def pause(self, timeout_s: float | None) -> None:
        """Let others run until the time has passed or ``wake`` is called for the running task."""
        task = self._task()
        task.waits += 1
        if timeout_s is None:
            task.until_s = None
        else:
            until_s = self.now_s + timeout_s
            if until_s == self.now_s and timeout_s > 0.0:
                # Below the resolution of virtual time: a reader that waits by its own, finer clock
                # would wait forever.
                until_s = math.nextafter(until_s, math.inf)
            task.until_s = until_s
            # One timer per task: a pause that ends after the pending timer sets no other.
            if until_s < task.timer_s:
                self._set_timer(task, until_s)
        self._hub.switch()

    def _set_timer(self, task: Task, time_s: float) -> None:
        task.timer_s = time_s
        self.call_at(time_s, self._on_timer, args=(task,))

    def _on_timer(self, task: Task) -> None:
        """Continue a task whose pause has ended, or set the timer for the end of its present
        pause.
        """
        if task.timer_s <= self.now_s:
            task.timer_s = math.inf
        until_s = task.until_s
        if until_s is None:
            return
        if until_s <= self.now_s:
            self._continue(task, task.waits)
        elif until_s < task.timer_s:
            self._set_timer(task, until_s)

    def wake(self, task: Task) -> None:
        """Continue a pausing task at the present time.

        Other events of this time tend to come first, so that a reader often finds several messages.
        """
        self._count += 1
        place = self._count + WAKE_SPREAD * self._draw()
        event = (self.now_s, place, self._count, self._continue, (task, task.waits))
        heapq.heappush(self._events, event)

    def _task(self) -> Task:
        if self._running is None:
            raise RuntimeError("only a task may wait")
        return self._running

    @property
    def running(self) -> Task | None:
        """Return the task that runs now; None within a timed call."""
        return self._running

    def _continue(self, task: Task, stamp: int) -> None:
        if task.done or task.waits != stamp:
            return  # it was already continued
        task.waits += 1
        task.until_s = None
        self._running = task
        try:
            task.fiber.switch()
        finally:
            self._running = None
            self._alive -= task.done


class VirtualQueue(BoundedQueue[Any]):
    """A ``BoundedQueue`` whose reader waits in virtual time, by a clock of this rate.

    ``before_take``: if given, runs in the reader's task before it takes an item. ``most``: largest
    number of items so far.
    """

    def __init__(
        self, scheduler: Scheduler, before_take: Callable[[], None] | None, rate: float = 1.0
    ) -> None:
        super().__init__()
        self.most = 0
        self._scheduler = scheduler
        self._before_take, self._rate = before_take, rate
        self._waiting_items: deque[tuple[Any, int]] = deque()
        self._reader: Task | None = None

    def put(self, item: Any, size: int) -> bool:
        """See ``BoundedQueue.put``."""
        items = self._waiting_items
        if self._bytes + size > self._max_bytes or len(items) >= self._max_items:
            self.dropped += 1
            return False
        self._bytes += size
        items.append((item, size))
        if len(items) > self.most:
            self.most = len(items)
        if self._reader is not None:
            self._scheduler.wake(self._reader)
            self._reader = None
        return True

    def get(self, timeout_s: float | None) -> Any:
        """See ``BoundedQueue.get``."""
        items = self._waiting_items
        if timeout_s != 0:
            if self._before_take is not None:
                self._before_take()
            if not items:
                self._reader = self._scheduler.running
                self._scheduler.pause(None if timeout_s is None else timeout_s / self._rate)
                self._reader = None
        if not items:
            raise queue.Empty
        item, size = items.popleft()
        self._bytes -= size
        return item

    def empty(self) -> bool:
        return not self._waiting_items
