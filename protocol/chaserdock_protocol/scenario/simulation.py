# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[simulation]``: conditions of the simulated network of ``chaserdock simulate``
(docs/simulation.md).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .faults import Process
from .fields import NotNegative, Positive, Section

MessageShare = Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]
Delay = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Partition(Section):
    """A time in which some processes are cut off from all others. What may not be lost arrives when
    it is over.
    """

    at_s: NotNegative = Field(description="Begin, s of mission time.")
    duration_s: Positive = Field(description="Duration, s.")
    processes: tuple[Process, ...] = Field(
        min_length=1,
        max_length=20,
        description="Processes on one side; all others are on the other.",
    )

    def separates(self, a: str, b: str) -> bool:
        """Return whether two processes are on different sides."""
        return (a in self.processes) != (b in self.processes)


class SlowReader(Section):
    """A time in which a process takes long to read each message."""

    at_s: NotNegative = Field(description="Begin, s of mission time.")
    duration_s: Positive = Field(description="Duration, s.")
    process: Process = Field(description="Process that reads slowly.")
    each_s: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = Field(
        description="Time that each message takes, s."
    )


class ProcessClock(Section):
    """Error of the monotonic clock of a process."""

    process: Process = Field(description="Process whose clock is wrong.")
    offset_s: Annotated[float, Field(ge=-1e6, le=1e6)] = Field(
        default=0.0, description="Offset, s."
    )
    drift: Annotated[float, Field(ge=-0.05, le=0.05)] = Field(
        default=0.0, description="Relative error of its rate."
    )


class SimulationSection(Section):
    """Network and clocks under `chaserdock simulate`; `chaserdock run` ignores it."""

    mode: Literal["lockstep", "realtime"] = Field(
        default="lockstep",
        description="Whether simulated time waits for every process. In `lockstep`, as on TCP "
        "links, latency and partitions delay messages; only in `realtime` are they lost.",
    )
    latency_s: Delay = Field(default=0.0, description="Latency of each message, s.")
    jitter_s: Delay = Field(
        default=0.0, description="Mean of an exponentially distributed further latency, s."
    )
    loss: MessageShare = Field(default=0.0, description="Share of the messages that are lost.")
    duplicate: MessageShare = Field(
        default=0.0, description="Share of the messages that arrive twice."
    )
    reorder: MessageShare = Field(
        default=0.0, description="Share of the messages that later ones may overtake."
    )
    partition: tuple[Partition, ...] = Field(default=(), max_length=20)
    slow: tuple[SlowReader, ...] = Field(default=(), max_length=20)
    clock: tuple[ProcessClock, ...] = Field(default=(), max_length=20)
