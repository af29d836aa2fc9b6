# SPDX-License-Identifier: Apache-2.0
"""Spreads calls over processes of this machine, or over the workers of a Dask cluster.

Each call runs in a process that runs nothing else meanwhile, also on a worker with several threads.
A process that has ended is replaced, and its call is repeated. A process whose chaserdock, Python
or packages are others than here runs no call. Calls and results travel as JSON, a line each.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, BinaryIO, Generic, TypeVar

import msgspec
from chaserdock_protocol.errors import ChaserdockError, require_extra
from chaserdock_protocol.process import SINGLE_THREADED

from chaserdock.launch.signals import interrupts
from chaserdock.version import Version, difference, version

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Places:
    """Where calls run: ``jobs`` at a time on this machine, or on the Dask scheduler at
    ``cluster``.
    """

    jobs: int = 1
    cluster: str | None = None


HERE = Places()
"""One call after the other in this process."""


@dataclass(frozen=True)
class Lost:
    """A call without a result, and the reason: what it returned in place of one, an exception, of
    which its process printed the traceback, or that it ended each process that ran it.
    """

    reason: str


@dataclass(frozen=True)
class ServedCall(Generic[T, R]):
    """A function that other processes can call: ``python -m MODULE`` serves it (``serve``).

    ``takes``, ``gives``: types of its argument and its result, which msgspec can encode.
    """

    module: str
    call: Callable[[T], R | Lost]
    takes: type[T]
    gives: type[R]


class _Answer(msgspec.Struct, omit_defaults=True):
    """The end of a call: its result, why it was lost, or the error that ends all calls."""

    result: msgspec.Raw = msgspec.Raw()
    lost: str | None = None
    error: str | None = None


@dataclass(frozen=True)
class _Settings:
    attempts: int = 2  # processes that a call may end: one may be chance, as when memory is short
    idle_s: float = 60.0  # a process on a worker ends without calls: next ones come in ms
    end_s: float = 5.0  # time in which a process ends its call and removes its files
    ahead: float = 1.25  # calls per thread of a cluster: others wait while a result is on its way
    look_s: float = 2.0  # interval at which workers that have joined are counted
    connect_s: float = 10.0  # a scheduler beside or far away answers within a second


_SETTINGS = _Settings()


def spread(
    task: ServedCall[T, R],
    items: Iterable[T],
    places: Places = HERE,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[tuple[T, R | Lost], None, None]:
    """Yield each item with the result of its call, as they end. Begin none once ``stop()``.

    One job on this machine runs in this process. Other processes of this machine end when the
    generator does. Raises ChaserdockError, as a call does, or if a worker is not as this process.
    """
    if places.cluster is None and places.jobs == 1:
        for item in items:
            if stop():
                return
            yield item, task.call(item)
        return
    expected, waiting = version(), iter(items)
    with _on_cluster(places.cluster) if places.cluster else _on_processes(places.jobs) as pool:
        active: dict[Future[bytes], T] = {}
        while True:
            room = pool.room() - len(active)
            for item in () if stop() else islice(waiting, max(room, 0)):
                call = msgspec.json.encode(item)
                active[pool.submit(task.module, call, expected)] = item
            if not active:
                return
            for future in wait(active, _SETTINGS.look_s, FIRST_COMPLETED).done:
                yield active.pop(future), _opened(pool.answer(future), task, places)


def _opened(line: bytes, task: ServedCall[Any, R], places: Places) -> R | Lost:
    """Return the result in an answer. Raises the error in it."""
    answer = msgspec.json.decode(line, type=_Answer)
    if answer.error is not None:
        where = f"--cluster {places.cluster}: " if places.cluster else ""
        raise ChaserdockError(where + answer.error)
    if answer.lost is not None:
        return Lost(answer.lost)
    return msgspec.json.decode(answer.result, type=task.gives)


# -- The process of a call -------------------------------------------------------------------------


def serve(task: ServedCall[Any, Any]) -> None:
    """Answer the calls that arrive on standard input, until it is closed or none arrives for long.

    What calls print goes to standard error.
    """
    calls: queue.Queue[bytes] = queue.Queue(maxsize=1)

    def read(arriving: BinaryIO) -> None:
        for line in arriving:
            calls.put(line)
        calls.put(b"")
        os.kill(os.getpid(), signal.SIGTERM)  # nobody waits for the result

    # Copies, so that neither calls nor programs that they start read or write them.
    arriving = os.fdopen(os.dup(0), "rb")
    with (
        suppress(queue.Empty, KeyboardInterrupt, BrokenPipeError),
        interrupts(),  # as an exception: a call removes its files
        os.fdopen(os.dup(1), "wb") as answers,
        open(os.devnull, "rb") as nothing,
    ):
        os.dup2(nothing.fileno(), 0)
        os.dup2(2, 1)
        answers.write(msgspec.json.encode(version()) + b"\n")
        answers.flush()
        threading.Thread(target=read, args=(arriving,), name="calls", daemon=True).start()
        while line := calls.get(timeout=_SETTINGS.idle_s):
            answers.write(msgspec.json.encode(_answer(task, line)) + b"\n")
            answers.flush()


def _answer(task: ServedCall[Any, Any], line: bytes) -> _Answer:
    try:
        result = task.call(msgspec.json.decode(line, type=task.takes))
        if isinstance(result, Lost):
            return _Answer(lost=result.reason)
        return _Answer(msgspec.Raw(msgspec.json.encode(result)))
    except ChaserdockError as error:
        return _Answer(error=str(error))
    except Exception as error:
        traceback.print_exc()
        return _Answer(lost=f"{type(error).__name__}: {error}")


class _Process:
    """A process that serves calls of a module, one after the other. ``version``: of what it
    imports.
    """

    def __init__(self, module: str) -> None:
        self.module = module
        # In a session of its own: Ctrl-C in the terminal reaches its parent only.
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | SINGLE_THREADED,
            start_new_session=True,
        )

    @cached_property
    def version(self) -> Version:
        """Raise EOFError if the process does not start."""
        return msgspec.json.decode(self._receive(), type=Version)

    def answer(self, call: bytes) -> bytes:
        """Return the answer to a call. Raise EOFError or OSError if the process ends."""
        assert self._process.stdin is not None
        self._process.stdin.write(call + b"\n")
        self._process.stdin.flush()
        return self._receive()

    def _receive(self) -> bytes:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line.endswith(b"\n"):
            raise EOFError
        return line

    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def stop(self) -> None:
        """Let the process end its call now: its input ends."""
        with suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    def end(self) -> int:
        """Wait for a process that was stopped, kill it if it does not end; return its status."""
        try:
            return self._process.wait(_SETTINGS.end_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
        finally:
            assert self._process.stdout is not None
            self._process.stdout.close()


class _Processes:
    """The processes that run calls, one for each thread."""

    def __init__(self) -> None:
        self._of: dict[int, _Process] = {}
        self._lock, self._closed = threading.Lock(), False

    def run(
        self, module: str, call: bytes, expected: Version, where: str = "this machine"
    ) -> bytes:
        """Run a call in the process of this thread; return its answer."""
        status = 0
        for _ in range(_SETTINGS.attempts):
            if (process := self._mine(module)) is None:
                break
            with suppress(EOFError, OSError):
                if differs := difference(process.version, expected):
                    return msgspec.json.encode(_Answer(error=f"{where} has {differs}"))
                return process.answer(call)
            process.stop()
            status = process.end()
        why = " (killed, as when memory is short)" if status == -signal.SIGKILL else ""
        lost = f"its process ended with status {status}{why}"
        return msgspec.json.encode(_Answer(lost=lost))

    def _mine(self, module: str) -> _Process | None:
        """Return the process of this thread, a new one if it has ended or serves another module;
        None once closed.
        """
        thread = threading.get_ident()
        with self._lock:
            if self._closed:
                return None
            process = self._of.get(thread)
            if process is not None and process.module != module:
                process.stop()
            if process is None or process.has_ended() or process.module != module:
                self._of[thread] = process = _Process(module)
            return process

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            self._closed = True
        for process in self._of.values():
            process.stop()
        for process in self._of.values():
            process.end()


class _Pool:
    """A pool of processes of this machine."""

    def __init__(self, jobs: int, executor: Executor, processes: _Processes) -> None:
        self._jobs, self._executor, self._processes = jobs, executor, processes

    def room(self) -> int:
        """Return how many calls to have in the pool."""
        return self._jobs

    def submit(self, module: str, call: bytes, expected: Version) -> Future[bytes]:
        return self._executor.submit(self._processes.run, module, call, expected)

    def answer(self, future: Future[bytes]) -> bytes:
        """Return the answer to a call that has ended."""
        return future.result()


@contextmanager
def _on_processes(jobs: int) -> Iterator[_Pool]:
    processes = _Processes()
    with ThreadPoolExecutor(jobs) as executor:
        try:
            yield _Pool(jobs, executor, processes)
        finally:
            processes.close()


# -- Dask ------------------------------------------------------------------------------------------

_ON_WORKER = _Processes()
"""Processes of a Dask worker, which they outlive by the end of a call at most."""


def run_on_worker(module: str, call: bytes, expected: Version) -> bytes:
    """Run a call on the Dask worker that this is."""
    from distributed import get_worker

    return _ON_WORKER.run(module, call, expected, f"worker {get_worker().address}")


class _Cluster:
    """The workers of a Dask scheduler."""

    def __init__(self, address: str, client: Any) -> None:
        self._address, self._client = address, client
        # pure=False: Dask must not take the result of an equal call.
        self._executor = client.get_executor(pure=False)

    def room(self) -> int:
        """Return how many calls to have on the cluster; one waits for the first worker."""
        with self._errors():
            return max(1, round(_SETTINGS.ahead * sum(self._client.nthreads().values())))

    def submit(self, module: str, call: bytes, expected: Version) -> Future[bytes]:
        with self._errors():
            return self._executor.submit(run_on_worker, module, call, expected)

    def answer(self, future: Future[bytes]) -> bytes:
        """Return the answer to a call that has ended. Raises ChaserdockError."""
        from distributed import KilledWorker

        try:
            with self._errors():
                return future.result()
        except KilledWorker as error:
            workers, last = error.allowed_failures + 1, error.last_worker.address
            lost = f"{workers} workers ended while they ran it, the last one {last}"
            return msgspec.json.encode(_Answer(lost=lost))
        except ChaserdockError:
            raise
        except Exception as error:
            self.refuse_others()  # such as one that has joined without chaserdock
            raise ChaserdockError(
                f"--cluster {self._address}: a worker could not run a call: "
                f"{type(error).__name__}: {error}"
            ) from error

    def refuse_others(self) -> None:
        """Raise ChaserdockError if a worker has not what this process has."""
        expected = version()
        with self._errors():
            found = self._client.run(version, on_error="return")
        for worker, theirs in found.items():
            if isinstance(theirs, Exception):
                differs = f"no chaserdock of this version ({theirs}), here {expected['chaserdock']}"
            else:
                differs = difference(theirs, expected)
            if differs:
                raise ChaserdockError(f"--cluster {self._address}: worker {worker} has {differs}")

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Raise ChaserdockError if the scheduler is lost."""
        try:
            yield
        except (OSError, TimeoutError, CancelledError) as error:
            raise ChaserdockError(
                f"--cluster {self._address}: the scheduler is lost ({type(error).__name__}); "
                "repeat the command once it answers again"
            ) from None


@contextmanager
def _on_cluster(address: str) -> Iterator[_Cluster]:
    """Yield the cluster at an address, all of whose workers are as this process.

    Raises ChaserdockError, and MissingPackageError without Dask.
    """
    require_extra("distributed", "cluster")
    from distributed import Client

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what concerns users is raised
    with ExitStack() as stack:
        try:
            client: Any = stack.enter_context(Client(address, timeout=_SETTINGS.connect_s))
        except (OSError, ValueError, TimeoutError) as error:
            raise ChaserdockError(
                f"--cluster {address}: no Dask scheduler answers: {error}"
            ) from None
        cluster = _Cluster(address, client)
        cluster.refuse_others()
        yield cluster
