# SPDX-License-Identifier: Apache-2.0
"""The operator of the virtual laboratory commands approaches again only where a person would."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import virtual_lab
from chaserdock_protocol.messages import CommandReply, MissionEnd, OperatorCommand, Reference
from chaserdock_protocol.process import ProcessOptions
from virtual_lab import HELD_S, LONGEST_S, approach_again

STEP_S = 0.5


def reference(phase: Any, phase_time_s: float, chaser: int = 1) -> Reference:
    still = (0.0, 0.0, 0.0)
    return Reference(
        tick=0, sim_time_ns=0, chaser=chaser, phase=phase, phase_time_s=phase_time_s,
        position_m=still, q_wxyz=(1.0, 0.0, 0.0, 0.0), offset_m=still, min_distance_target_m=0.0,
    )  # fmt: skip


END = MissionEnd(tick=0, sim_time_ns=0, reason="completed", complete=True)


def commanded(
    monkeypatch: pytest.MonkeyPatch, messages: Sequence[Any], refusals: int = 0
) -> tuple[int, list[tuple[int, OperatorCommand]]]:
    """Let the operator hear ``messages``; return its status, and its commands with the number of
    messages before each. The first ``refusals`` of them are refused.
    """
    heard, asked = 0, []

    class Heard:
        def __init__(self, *_: Any) -> None:
            self.host = SimpleNamespace(now_s=lambda: heard * STEP_S)

        def subscribe(self, topic: Any) -> None: ...

        def close(self) -> None: ...

        def receive(self, timeout_s: float) -> Any:
            nonlocal heard
            heard += 1
            message = messages[heard - 1] if heard <= len(messages) else None
            return None if message is None else SimpleNamespace(message=message)

        def query(self, key: str, command: OperatorCommand, *_: Any) -> CommandReply:
            asked.append((heard, command))
            return CommandReply(
                tick=0, sim_time_ns=0, command=command.command, chaser=command.chaser,
                accepted=len(asked) > refusals, reason="",
            )  # fmt: skip

    monkeypatch.setattr(virtual_lab, "Node", Heard)
    return approach_again(ProcessOptions()), asked


@pytest.mark.parametrize("phase", ["retreat", "abort"])
def test_a_chaser_that_has_backed_out_and_holds_is_commanded_once(
    phase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = [
        reference("approach", 9.0), reference(phase, 0.1), reference("hold", 0.1),
        None, reference("hold", HELD_S), reference("hold", HELD_S + 0.1),
        reference("hold", HELD_S + 0.2), reference("align", 0.1), END,
    ]  # fmt: skip
    status, asked = commanded(monkeypatch, flown)
    assert status == 0
    assert [(n, c.command, c.chaser) for n, c in asked] == [(6, "approach", 1)]


def test_a_chaser_that_only_holds_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = [reference("retreat", 1.0, chaser=0), reference("hold", 9.0), END]
    assert commanded(monkeypatch, flown) == (0, [])


def test_a_command_that_is_refused_is_given_again(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = [reference("retreat", 1.0), *(reference("hold", HELD_S + k) for k in (1, 2, 3)), END]
    status, asked = commanded(monkeypatch, flown, refusals=1)
    assert (status, [n for n, _ in asked]) == (0, [2, 3])


def test_a_mission_that_does_not_end_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    status, asked = commanded(monkeypatch, [None] * (round(LONGEST_S / STEP_S) + 2))
    assert (status, asked) == (1, [])
