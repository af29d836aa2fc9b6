# SPDX-License-Identifier: Apache-2.0
"""Recorders over real Zenoh: a log played and recorded again is the same; what a killed one
has written is recovered.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import threading
from collections import defaultdict
from pathlib import Path

import pytest
from chaserdock_protocol.recording.log import LogError, read_scenario
from chaserdock_protocol.recording.scan import log_files, stored_messages
from chaserdock_protocol.transport import Link, RawSample
from harness import chaserdock, finished
from motion_cases import without_truth

from chaserdock.analysis.summary import summarize
from chaserdock.launch.launcher import free_port
from chaserdock.logs.info import info_of
from chaserdock.logs.player import play, stored_samples
from chaserdock.logs.recover import recover

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"
KILLS = int(os.environ.get("CHASERDOCK_KILLS", "2"))


def start_recorder(
    folder: Path, port: int, namespace: str, *options: str
) -> subprocess.Popen[bytes]:
    """The recorder process, which joins the player on that port."""
    where = ["-e", f"tcp/127.0.0.1:{port}", "--namespace", namespace]
    return chaserdock("record", "--out", str(folder), *where, *options, stdout=subprocess.DEVNULL)


def messages_in(log: Path) -> int:
    """Return the number of messages that can be read of a log which is being written."""
    try:
        return sum(1 for _ in stored_messages(log))
    except (FileNotFoundError, LogError):
        return 0


def by_key(log: Path) -> dict[str, list[tuple[str, bytes]]]:
    """Encodings and payloads of a log, key by key, in their order; without what its own recorder
    wrote.
    """
    out: dict[str, list[tuple[str, bytes]]] = defaultdict(list)
    for _, raw in stored_samples(log):
        out[raw.key].append((raw.encoding, raw.payload))
    return dict(out)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [(), ("--rotate-time", "1"), ("--no-viewer",)], ids=["one file", "rotated", "bare"]
)
def test_played_and_recorded_again_is_the_same(tmp_path: Path, options: tuple[str, ...]) -> None:
    port = free_port()
    recorder = start_recorder(tmp_path / "again", port, "again", *options)
    try:
        arguments = ("--namespace", "again", "-l", f"tcp/127.0.0.1:{port}")
        status, said = finished("play", str(GOLDEN), *arguments)
        assert status == 0, said
        assert recorder.wait(timeout=60) == 0
    finally:
        recorder.kill()
        recorder.wait()
    assert by_key(tmp_path / "again") == by_key(GOLDEN)
    assert read_scenario(tmp_path / "again")[0] == read_scenario(GOLDEN)[0]
    assert read_scenario(tmp_path / "again")[1]["scenario"] == "full"
    info = info_of(tmp_path / "again")
    assert info.whole
    assert (info.viewer > 100) == ("--no-viewer" not in options)
    names = [path.name for path in log_files(tmp_path / "again")]
    rotated = [
        f"mission-{k:04d}.mcap" for k in range(max(2, len(names)))
    ]  # by wall time: two, or more under load
    assert names == (rotated if "--rotate-time" in options else ["mission.mcap"])
    for path in log_files(tmp_path / "again"):  # each stands for itself
        assert read_scenario(path)[1]["run_id"] == read_scenario(GOLDEN)[1]["run_id"]


@pytest.mark.slow
def test_world_that_gives_no_full_scenario_is_recorded_with_that_of_the_flight(
    tmp_path: Path,
) -> None:
    """Played from such a log, the world has no scenario to give: the recorder takes that of its
    join, says so, and lacks no message."""
    bodies = ("target", "chaser/0")
    source = without_truth(GOLDEN, tmp_path / "source.mcap", bodies, flight=True)
    port = free_port()
    where = ["-e", f"tcp/127.0.0.1:{port}", "--namespace", "lab"]
    recorder = chaserdock(
        "record",
        *("--out", str(tmp_path / "again"), *where),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    try:
        arguments = ("--namespace", "lab", "-l", f"tcp/127.0.0.1:{port}")
        status, said = finished("play", str(source), *arguments)
        assert status == 0, said
        words = recorder.communicate(timeout=60)[0].decode()
        assert recorder.returncode == 0, words
    finally:
        recorder.kill()
        recorder.wait()
    assert "the world gave no scenario on truth/scenario within 10 s" in words
    assert "The log holds the flight scenario alone." in words
    assert by_key(tmp_path / "again") == by_key(source)
    scenario, run = read_scenario(tmp_path / "again")
    assert (scenario, run["scenario"]) == (read_scenario(source)[0], "flight")
    assert summarize(tmp_path / "again")["judged_against"].startswith("motion capture 'optitrack'")


def test_play_without_a_recorder_is_refused(tmp_path: Path) -> None:
    arguments = ("--namespace", "nobody", "-l", "tcp/127.0.0.1:0", "--timeout", "0.5")
    status, said = finished("play", str(GOLDEN), *arguments)
    assert (status, "Traceback" in said) == (2, False)
    assert "no recorder joined within 0.5 s" in said


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(KILLS))
def test_what_a_killed_recorder_has_written_is_recovered(tmp_path: Path, seed: int) -> None:
    """SIGKILL at a random moment of a flight at a quarter of its speed, after the first flush. How
    late a flush may be: test_log_ends.py.
    """
    port, log = free_port(), tmp_path / "killed" / "mission.mcap"
    recorder = start_recorder(log.parent, port, "killed")
    sent: dict[str, list[bytes]] = defaultdict(list)
    written: list[int] = []
    over = threading.Event()

    def note(raw: RawSample) -> None:
        sent[raw.key].append(raw.payload)

    def kill() -> None:
        while not over.wait(0.05) and not messages_in(log):
            pass
        over.wait(random.Random(seed).uniform(0.0, 3.0))
        written.append(messages_in(log))
        recorder.send_signal(signal.SIGKILL)
        over.set()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        play(GOLDEN, Link("killed", (), (f"tcp/127.0.0.1:{port}",)), 0.25, 60.0, note, over.is_set)
    finally:
        over.set()
        killer.join()
        recorder.wait()
    recover(log, tmp_path / "whole.mcap")
    held: dict[str, list[bytes]] = defaultdict(list)
    for channel, message in stored_messages(tmp_path / "whole.mcap"):
        held[channel.topic].append(message.data)
    assert sum(map(len, held.values())) >= written[0] > 0
    for key, payloads in held.items():
        if not key.startswith(("/viewer/", "recorder/")):
            assert payloads == sent[key][: len(payloads)], key
    assert not info_of(tmp_path / "whole.mcap").whole
