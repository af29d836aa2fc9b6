# SPDX-License-Identifier: Apache-2.0
"""Cooperative scheduler in virtual time: tasks that run one at a time and hand over only where they wait.

A task is a greenlet. It runs until it waits for a time or an item; the scheduler then advances virtual time to the next
event and continues the task that it wakes. Events at equal times come in an order drawn from the seed, so that a seed
repeats a run exactly and seeds differ in their interleavings.
"""

from __future__ import annotations

import heapq
import queue
import random
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from greenlet import GreenletExit, getcurrent, greenlet


class Killed(BaseException):
    """Ends a task from within, as SIGKILL ends a process."""


Due = tuple[float, float]
"""Virtual time (s) of an event, and its place among those of the same time."""
NEVER: Due = (0.0, 0.0)


class Task:
    """One task. ``result`` is its return value; ``error`` the traceback of the exception that ended it, empty if none did."""

    def __init__(self, name: str, work: Callable[[], Any]) -> None:
        self.name = name
        self.done = False
        self.killed = False
        self.result: Any = None
        self.error = ""
        self.waits = 0
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
        self._events: list[tuple[float, float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = self._alive = 0
        self._hub: greenlet = getcurrent()
        self._running: Task | None = None

    def call_at(
        self, time_s: float, call: Callable[..., None], after: Due = NEVER, args: tuple[Any, ...] = ()
    ) -> Due:
        """Call ``call(*args)``, which must not wait, at a time and after the call of ``after``; return when.

        At once if the time has passed.
        """
        self._count += 1
        now_s = self.now_s
        due = (time_s if time_s > now_s else now_s, self._draw())
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
        """Run until all tasks have ended; return False if they have not by ``limit_s``, or when ``over`` holds."""
        self._hub = getcurrent()
        events = self._events
        while self._alive:
            if not events or events[0][0] > limit_s or (over is not None and over()):
                return False
            self.now_s, _, _, call, args = heapq.heappop(events)
            call(*args)
        return True

    def end(self) -> None:
        """End all tasks where they wait."""
        for task in self.tasks:
            if not task.done and task.fiber:
                task.fiber.throw(GreenletExit)
            task.done = True
        self._events.clear()

    # -- for tasks -----------------------------------------------------------------------------------------------

    def pause(self, timeout_s: float | None) -> None:
        """Let others run until the time has passed or ``wake`` is called for the running task."""
        task = self._task()
        task.waits += 1
        stamp = task.waits
        if timeout_s is not None:
            self.call_at(self.now_s + timeout_s, self._continue, args=(task, stamp))
        self._hub.switch()

    def wake(self, task: Task) -> None:
        """Continue a task that pauses, at the present time."""
        self.call_at(self.now_s, self._continue, args=(task, task.waits))

    def _task(self) -> Task:
        if self._running is None:
            raise RuntimeError("only a task may wait")
        return self._running

    @property
    def running(self) -> Task | None:
        """The task that runs now; None within a timed call."""
        return self._running

    def _continue(self, task: Task, stamp: int) -> None:
        if task.done or task.waits != stamp:
            return  # it was continued before
        task.waits += 1
        self._running = task
        try:
            task.fiber.switch()
        finally:
            self._running = None
            self._alive -= task.done


class VirtualQueue:
    """An ``ItemQueue`` whose reader waits in virtual time, by a clock of this rate.

    ``before_take`` runs in the reader's task before it takes an item. ``most``: most items that have been in it.
    """

    def __init__(self, scheduler: Scheduler, before_take: Callable[[], None], rate: float = 1.0) -> None:
        self.most = 0
        self._scheduler = scheduler
        self._before_take, self._rate = before_take, rate
        self._items: deque[Any] = deque()
        self._waiting: Task | None = None

    def put(self, item: Any) -> None:
        self._items.append(item)
        if len(self._items) > self.most:
            self.most = len(self._items)
        if self._waiting is not None:
            self._scheduler.wake(self._waiting)
            self._waiting = None

    def get(self, *, timeout: float | None) -> Any:
        """Remove and return the oldest item. Raises queue.Empty on timeout."""
        self._before_take()
        if not self._items:
            self._waiting = self._scheduler.running
            self._scheduler.pause(None if timeout is None else timeout / self._rate)
            self._waiting = None
            if not self._items:
                raise queue.Empty
        return self._items.popleft()

    def get_nowait(self) -> Any:
        if not self._items:
            raise queue.Empty
        return self._items.popleft()

    def qsize(self) -> int:
        return len(self._items)

    def empty(self) -> bool:
        return not self._items
