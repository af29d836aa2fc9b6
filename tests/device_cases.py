# SPDX-License-Identifier: Apache-2.0
"""Devices of the gateway for tests: opened by the entry points of pyproject.toml, with a clock by
hand, and commands in general position.
"""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.gateway import devices
from chaserdock_agents.gateway.devices import DeviceError, DeviceHost, DeviceKind, RobotCommand
from harness import ROOT

WAIT_S = 30.0


@dataclass
class Clock:
    """A clock that only tests move."""

    time_ns: int = 5_000_000_000

    def now_ns(self) -> int:
        return self.time_ns


def use_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find drivers by pyproject.toml, whatever was installed when."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups: dict[str, dict[str, str]] = project["entry-points"]
    monkeypatch.setattr(
        devices,
        "entry_points",
        lambda group: [EntryPoint(n, v, group) for n, v in groups.get(group, {}).items()],
    )


def open_device(
    kind: DeviceKind, address: str, options: dict[str, Any], clock: Clock | None = None
) -> Any:
    return devices.open_device(
        kind, address, options, DeviceHost(clock.now_ns if clock else time.monotonic_ns)
    )


def wait_for(holds: Callable[[], Any]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def command(
    force: Any = (0.31, -0.47, 0.12), torque: Any = (-0.021, 0.034, 0.058), duty: Any = ()
) -> RobotCommand:
    """Return a command in general position that takes effect now."""
    values = (np.array(v, dtype=float) for v in (force, torque, duty))
    return RobotCommand(time.monotonic_ns(), *values)


def poll_until(source: Any, number: int, publish: Any = lambda: None) -> list[Any]:
    """Return what has arrived after ``publish`` had its effect; the first messages may be lost."""
    polled: list[Any] = []

    def arrived() -> bool:
        publish()
        polled.extend(source.poll())
        return len(polled) >= number

    wait_for(arrived)
    return polled


def complains(source: Any, said: str, publish: Any = lambda: None) -> None:
    """Wait until a poll raises an error that says this."""

    def raised() -> bool:
        publish()
        try:
            source.poll()
        except DeviceError as error:
            return said in str(error)
        return False

    wait_for(raised)
