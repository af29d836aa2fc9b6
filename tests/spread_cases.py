# SPDX-License-Identifier: Apache-2.0
"""Calls that other processes serve, for tests of spreading: ``python -m spread_cases``."""

from __future__ import annotations

import math
import os
import signal
import time
from pathlib import Path

import msgspec
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.spread import Lost, ServedCall, serve


class Case(msgspec.Struct, frozen=True):
    """A call: what to do, and the number, or path, to do it with."""

    what: str
    number: float = 0.0
    path: str = ""


def run(case: Case) -> float | Lost:
    """Do it; return the square root of the number."""
    match case.what:
        case "sleep":
            time.sleep(case.number)
        case "lose":
            return Lost("lost")
        case "refuse":
            find_scenario("nowhere")
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "exit once" if not Path(case.path).exists():
            Path(case.path).touch()
            os._exit(3)
    return math.sqrt(case.number)


TASK = ServedCall("spread_cases", run, Case, float)


if __name__ == "__main__":
    serve(TASK)
