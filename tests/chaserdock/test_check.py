# SPDX-License-Identifier: Apache-2.0
"""``chaserdock check``: conforming processes pass, every kind of violation is found."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import encoding_of
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import RawSample
from harness import ROOT, finished

from chaserdock.conformance.rules import Ledger
from chaserdock.conformance.ticks import CheckError, Recorded, read_turns

LOG = ROOT / "tests" / "golden" / "two-chasers.mcap"
FOREIGN = ROOT / "examples" / "foreign_controller" / "foreign_controller.py"
PROCESSES = ("controller", "chaser/0", "chaser/1")


@pytest.fixture(scope="module")
def published() -> dict[str, list[tuple[int, RawSample]]]:
    """Return the messages of every process in the golden flight, with their ticks."""
    out: dict[str, list[tuple[int, RawSample]]] = {name: [] for name in PROCESSES}
    for record in read_log(LOG):
        raw = RawSample(
            record.key, encoding_of(type(record.message)), codec.encode(record.message), 0
        )
        for name in PROCESSES:
            if record.key.startswith(f"{name}/"):
                out[name].append((record.message.tick, raw))
    return out


def instance_of(messages: list[tuple[int, RawSample]]) -> str:
    raw = next(r for _, r in messages if r.key.endswith("/presence"))
    return codec.decode(topics.PRESENCE.kind, raw.payload).instance  # pyright: ignore[reportAttributeAccessIssue]


def keep(process: str, messages: list[tuple[int, RawSample]], recorded: Recorded) -> Ledger:
    """Return the ledger after a whole flight, with each tick's messages after its opening."""
    ledger = Ledger(process, recorded.scenario, instance_of(messages))
    end = recorded.turns[-1].tick.tick
    # Presence has no tick and comes first; the farewell comes last.
    ordered = sorted(messages, key=lambda m: (m[1].key.endswith("/farewell"), m[0]))
    for raw in (r for t, r in ordered if t < 0):
        ledger.add(raw)
    for turn in recorded.turns:
        ledger.open(turn)
        for tick, raw in ordered:
            if tick == turn.tick.tick and not raw.key.endswith("/farewell"):
                ledger.add(raw)
        if ledger.due():
            ledger.miss(1.0)
    for tick, raw in ordered:
        if tick > end or raw.key.endswith("/farewell"):
            ledger.add(raw)
    ledger.finish()
    return ledger


@pytest.mark.parametrize("process", PROCESSES)
def test_our_own_processes_conform_in_the_golden_flight(
    process: str, published: dict[str, list[tuple[int, RawSample]]]
) -> None:
    recorded = read_turns(LOG, process, 1000)
    assert len(recorded.turns) == 18
    ledger = keep(process, published[process], recorded)
    assert [f.line() for f in ledger.findings.values()] == []
    assert ledger.messages == len(published[process])


def changed(raw: RawSample, **fields: Any) -> RawSample:
    found = topics.topic_of_key(raw.key)
    assert found is not None
    message = msgspec.structs.replace(codec.decode(found[0].kind, raw.payload), **fields)
    return msgspec.structs.replace(raw, payload=codec.encode(message))


VIOLATIONS: list[tuple[str, Callable[[RawSample], list[RawSample]], str, str]] = [
    (
        "controller/target",
        lambda r: [msgspec.structs.replace(r, encoding="application/msgpack")],
        "",
        "wrong encoding",
    ),
    (
        "controller/target",
        lambda r: [msgspec.structs.replace(r, payload=b"\xff")],
        "",
        "not of the message's type",
    ),
    (
        "controller/target",
        lambda r: [changed(r, position_m=(math.nan, 0.0, 0.0))],
        "",
        "not finite",
    ),
    (
        "controller/target",
        lambda r: [changed(r, q_wxyz=(1.0, 1.0, 0.0, 0.0))],
        "",
        "not of unit length",
    ),
    ("controller/target", lambda r: [], "", "no answer within"),
    ("controller/target", lambda r: [], "", "seq does not count"),
    ("controller/target", lambda r: [r, r], "", "second answer"),
    ("controller/solver", lambda r: [changed(r, tick=6)], "", "another tick than the open one"),
    ("controller/solver", lambda r: [changed(r, sim_time_ns=1)], "", "wrong sim_time_ns"),
    (
        "controller/chaser/1/wrench",
        lambda r: [changed(r, effective_time_ns=1)],
        "",
        "wrong effective_time_ns",
    ),
    ("controller/chaser/1/wrench", lambda r: [changed(r, chaser=0)], "", "differs from the key's"),
    (
        "controller/chaser/1/wrench",
        lambda r: [changed(r, force_N=(1e3, 0.0, 0.0))],
        "",
        "the chaser rejects",
    ),
    (
        "controller/chaser/1/wrench",
        lambda r: [changed(r, term=7)],
        "",
        "not the term of its leases",
    ),
    (
        "controller/chaser/1/wrench",
        lambda r: [changed(r, instance="another")],
        "",
        "not the term of its leases",
    ),
    (
        "controller/target",
        lambda r: [r, msgspec.structs.replace(r, key="chaser/0/actuators")],
        "chaser/0/actuators",
        "must not write",
    ),
    (
        "controller/target",
        lambda r: [r, msgspec.structs.replace(r, key="truth/world")],
        "truth/world",
        "must not write",
    ),
    (
        "controller/target",
        lambda r: [r, msgspec.structs.replace(r, key="my/own")],
        "my/own",
        "not part of the protocol",
    ),
    (
        "controller/presence",
        lambda r: [changed(r, process="chaser/0")],
        "",
        "another process' presence",
    ),
    ("controller/farewell", lambda r: [], "", "no farewell"),
    (
        "controller/farewell",
        lambda r: [changed(r, published={})],
        "",
        "wrong number of published messages",
    ),
    (
        "controller/farewell",
        lambda r: [changed(r, process="world")],
        "",
        "another process' farewell",
    ),
]


@pytest.mark.parametrize(("key", "violation", "where", "what"), VIOLATIONS)
def test_violation_is_found(
    key: str,
    violation: Callable[[RawSample], list[RawSample]],
    where: str,
    what: str,
    published: dict[str, list[tuple[int, RawSample]]],
) -> None:
    recorded = read_turns(LOG, "controller", 1000)
    # At tick 5; always for presence and farewell, which have no tick.
    always = key in ("controller/presence", "controller/farewell")
    messages = [
        (tick, new)
        for tick, raw in published["controller"]
        for new in (violation(raw) if raw.key == key and (always or tick == 5) else [raw])
    ]
    lines = [f.line() for f in keep("controller", messages, recorded).findings.values()]
    assert any(line.startswith(where or key) and what in line for line in lines), lines


def test_unknown_process_is_rejected() -> None:
    for process in ("chaser/2", "world", "chaser/01", ""):
        with pytest.raises(CheckError):
            read_turns(LOG, process, 10)


def check(
    process: str, *command: str, ticks: int = 6, patience_s: float = 10.0, start_s: float = 60.0
) -> tuple[int, str]:
    limits = ("--ticks", str(ticks), "--timeout", str(patience_s), "--join-timeout", str(start_s))
    return finished("check", *limits, process, str(LOG), "--", *command)


@pytest.mark.slow
@pytest.mark.parametrize("process", ["controller", "chaser/0"])
def test_our_own_process_conforms(process: str) -> None:
    words = [sys.executable, "-m", "chaserdock", *process.split("/")]
    status, out = check(
        process, *words, "-e", "{endpoint}", "--namespace", "{namespace}", ticks=100
    )
    assert status == 0, out
    assert "conforms to the protocol; 18 ticks" in out


def foreign(path: Path, old: str = "", new: str = "") -> tuple[int, str]:
    """Check the foreign example with an injected fault."""
    source = FOREIGN.read_text()
    assert old in source
    path.write_text(source.replace(old, new, 1) if old else source)
    patience_s, start_s = (1.5, 5.0) if old else (10.0, 60.0)
    command = (sys.executable, "-I", str(path), "{endpoint}", "{namespace}")
    return check("controller", *command, patience_s=patience_s, start_s=start_s)


def test_foreign_example_conforms(tmp_path: Path) -> None:
    status, out = foreign(tmp_path / "foreign.py")
    assert status == 0, out


@pytest.mark.parametrize(
    ("old", "new", "finding"),
    [
        (
            'chaserdock.{kind}.v1"',
            "chaserdock.{kind}.v{1 + (kind == 'TargetEstimate')}" + '"',
            "wrong encoding",
        ),
        (
            "if tick is None or",
            'if tick and tick["tick"] == 3 or tick is None or',
            "controller/target: no answer",
        ),
        ("force_N=force,", 'force_N=[float("nan")] * 3,', "wrench: a number that is not finite"),
        (
            'f"{NAME}/target"',
            '"chaser/0/sighting"',
            "chaser/0/sighting: a key that controller must not write",
        ),
        ('            if key == "world/end":\n                break', "", "does not end within"),
        (
            'NAME, NAMESPACE = "controller"',
            'NAME, NAMESPACE = "chaser/0"',
            "joins under another name",
        ),
        ("self.session.liveliness().declare_token", "str", "live/controller: no liveliness token"),
        (
            "self.heard[message",
            "self.inbox, self.seen = self.inbox, [message",
            "has not discovered its partners",
        ),
    ],
)
def test_faulty_process_is_detected(old: str, new: str, finding: str, tmp_path: Path) -> None:
    status, out = foreign(tmp_path / "foreign.py", old, new)
    assert status == 1, out
    assert finding in out


@pytest.mark.parametrize(
    ("process", "command", "complaint"),
    [
        ("chaser/7", "true", "chasers are 0 to 1"),
        ("controller", "/no/such/program", "cannot be run"),
    ],
)
def test_impossible_check_states_the_reason(process: str, command: str, complaint: str) -> None:
    status, out = check(process, command)
    assert status == 2
    assert complaint in out
    assert "Traceback" not in out
