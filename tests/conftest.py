# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import os
import resource
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from harness import DRILL, SHORT, run
from hypothesis import settings

Fly = Callable[..., Path]

# The hundreds of processes that tests start would each compile every module again, and every run of
# the tests these.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Programs that a shell starts in the background ignore Ctrl-C, and so would all processes that
# tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# No verdict depends on the speed of the machine.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

FAST_S = 1.0
"""Processor time (s) that a test without the mark `slow` may take; others are reported."""


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need a shared flight as slow, and run the files with the longest missions
    first: at the end, workers share short tests, and none waits for another.
    """
    minutes: Counter[Path] = Counter()
    for item in items:
        if "shared_flight" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
        if slow := item.get_closest_marker("slow"):
            minutes[item.path] += slow.kwargs.get("minutes", 0.25)
    items.sort(key=lambda item: -minutes[item.path])


def processor_s() -> float:
    """Return the processor time of this process and of those that it has waited for (s)."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in used)


@contextmanager
def timed(item: pytest.Item) -> Iterator[None]:
    """Add the processor time of a part of a test to its report."""
    start_s = processor_s()
    try:
        yield
    finally:
        item.user_properties.append(("processor_s", processor_s() - start_s))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Count the fixtures that a test is the first to need."""
    with timed(item):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Count the test itself."""
    with timed(item):
        yield


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """List the tests that should be marked `slow`, but are not."""
    used = {
        report.nodeid: sum(s for name, s in report.user_properties if name == "processor_s")
        for report in terminalreporter.stats.get("passed", ())
        if "slow" not in report.keywords
    }
    over = {name: used_s for name, used_s in used.items() if used_s > FAST_S}
    if over:
        terminalreporter.section(f"not marked slow, more than {FAST_S:g} s of processor time")
    for name, used_s in sorted(over.items(), key=lambda item: -item[1]):
        terminalreporter.line(f"{used_s:6.1f} s  {name}")


@pytest.fixture(scope="session")
def shared_flight(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Fly:
    """Return a function that flies a scenario once per test session, whichever worker asks first,
    and returns its folder.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "shared-flights"
    folder.mkdir(exist_ok=True)

    def fly(name: str, scenario: str, *overrides: str, **options: Any) -> Path:
        out = folder / name
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            failure = folder / f"{name}.failed"
            if failure.exists():
                raise AssertionError(failure.read_text())
            if not out.exists():
                status, output = run(scenario, out, *overrides, **options)
                if status != 0:
                    failure.write_text(output)
                assert status == 0, output
        return out

    return fly


@pytest.fixture(scope="session")
def short_flight(shared_flight: Fly) -> Path:
    """A two-chaser flight of six seconds, with which others are compared."""
    return shared_flight("short", "two-chaser-tracking", *SHORT)


@pytest.fixture(scope="session")
def drill_flight(shared_flight: Fly) -> Path:
    """A six-second flight of ``fault-drill`` without faults, with which faulty ones are
    compared.
    """
    return shared_flight("drill", *DRILL)
