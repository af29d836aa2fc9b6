# SPDX-License-Identifier: Apache-2.0
"""Killed, frozen and duplicated processes, invalid scenarios and messages: no hang, no lost
records, clear errors.
"""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import time
from pathlib import Path

import msgspec
import psutil
import pytest
import zenoh
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import (
    Odometry,
    PoseSolution,
    Sighting,
    WrenchCommand,
    encoding_of,
)
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import Link
from chaserdock_protocol.transport.zenoh_network import zenoh_config
from harness import (
    SHORT,
    ByHand,
    all_gone,
    chaserdock,
    descendants,
    find_child,
    finished,
    free_port,
    run,
    sets,
    summary,
    wait_for_log,
)

from chaserdock.analysis.flight import load_flight
from chaserdock.launch import launcher

TWO = "two-chaser-tracking"
FLYING_BYTES = 300_000
LONG = (*SHORT, "duration_s=60.0")
GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"


@pytest.mark.slow
def test_existing_log_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mission.mcap").write_bytes(b"precious")
    status, output = run("single", tmp_path, timeout_s=30)
    assert status == 2
    assert "never overwritten" in output
    assert (tmp_path / "mission.mcap").read_bytes() == b"precious"


def test_world_reports_port_in_use() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        status, output = finished("world", "single", "-l", endpoint, timeout_s=60)
    assert status == 2
    assert "port is in use" in output
    assert endpoint in output


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("play", str(GOLDEN), "-m", "client"),
        ("ros2", "-m", "client"),
        ("world", "single", "-m", "client"),
    ],
)
def test_interrupt_ends_the_wait_for_a_router(arguments: tuple[str, ...]) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    process = chaserdock(
        *arguments, "-e", endpoint, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        assert process.stdout is not None
        assert any(b"Waiting for it" in line for line in process.stdout)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_chaser_and_operator_time_out_without_peers() -> None:
    """A chaser without a world and an operator without a controller end with status 2 after
    ``--timeout``.
    """
    elsewhere = ["-e", "tcp/127.0.0.1:9", "--namespace", "empty"]
    status, output = finished("chaser", "0", *elsewhere, "--timeout", "1", timeout_s=60)
    assert status == 2
    assert "no world answered" in output
    status, output = finished("command", "hold", "0", *elsewhere, "--timeout", "1", timeout_s=60)
    assert status == 2
    assert "no reply from the controller" in output


def foreign_session(by_hand: ByHand) -> zenoh.Session:
    return zenoh.open(zenoh_config(Link(by_hand.namespace, (by_hand.endpoint,))))


def malformed_messages() -> list[tuple[str, bytes, str]]:
    """Return keys, payloads and encodings that every process must reject."""
    zero = (0.0, 0.0, 0.0)
    odometry = Odometry(
        chaser=0, q_wxyz=(1.0, 0.0, 0.0, 0.0), position_m=zero, velocity_m_s=zero, omega_rad_s=zero
    )
    wrench = WrenchCommand(
        chaser=0,
        effective_time_ns=0,
        expires_ns=10**15,
        mode="nmpc",
        force_N=zero,
        torque_N_m=zero,
    )
    sighting = Sighting(
        chaser=0, status="nothing", solutions=(), marker_ids=(), corners_px=(), rejected_ids=()
    )
    turned = PoseSolution(
        position_m=zero,
        q_wxyz=(1.0, 1.0, 0.0, 0.0),
        covariance=(0.0,) * 36,
        reprojection_rms_px=0.0,
    )
    shape = msgspec.to_builtins(wrench) | {"force_N": [1.0, 2.0]}
    return [
        (topics.ODOMETRY.key_of(0), codec.encode(odometry), encoding_of(Odometry)),
        (
            topics.WRENCH.key_of(0),
            codec.encode(msgspec.structs.replace(wrench, force_N=(math.nan, 0.0, 0.0))),
            encoding_of(WrenchCommand),
        ),
        (
            topics.SIGHTING.key_of(0),
            codec.encode(msgspec.structs.replace(sighting, solutions=(turned,))),
            encoding_of(Sighting),
        ),
        (topics.WRENCH.key_of(0), msgspec.msgpack.encode(shape), encoding_of(WrenchCommand)),
        (
            topics.WRENCH.key_of(0),
            codec.encode(wrench),
            "application/msgpack;chaserdock.WrenchCommand.v99",
        ),
        (
            topics.WRENCH.key_of(0),
            codec.encode(msgspec.structs.replace(wrench, chaser=1)),
            encoding_of(WrenchCommand),
        ),
        (topics.SIGHTING.key_of(0), codec.encode(sighting)[:-4], encoding_of(Sighting)),
        (topics.ACTUATORS.key_of(0), b"\xc1 junk", "text/plain"),
        (topics.TICK.key_of(), b"", "application/msgpack;chaserdock.Tick.v1"),
    ]


@pytest.mark.slow
def test_invalid_messages_processes_and_commands_are_rejected_in_flight(tmp_path: Path) -> None:
    """A second world, a duplicate or unknown chaser, malformed messages and invalid commands do not
    disturb the flight.
    """
    by_hand = ByHand.at_free_port("rejections")
    reach = ["--namespace", by_hand.namespace, "-e", by_hand.endpoint]
    log = tmp_path / "mission.mcap"
    try:
        by_hand.start("world", "world", TWO, *sets(*LONG, "duration_s=30.0"))
        by_hand.start("recorder", "record", "--out", str(tmp_path))
        by_hand.start("controller", "controller")
        for i in range(2):
            by_hand.start(f"chaser/{i}", "chaser", str(i))
        wait_for_log(log, FLYING_BYTES)
        with foreign_session(by_hand) as session:
            time.sleep(1.0)
            for key, payload, encoding in malformed_messages():
                session.put(key, payload, encoding=encoding)
            status, output = finished("chaser", "7", *reach, timeout_s=60)
            assert (
                status,
                "there is no chaser/7 in this mission; its chasers are 0 to 1" in output,
            ) == (
                2,
                True,
            ), output
            status, output = finished("chaser", "1", *reach, timeout_s=60)
            assert (status, "chaser/1 is already running" in output) == (2, True), output
            status, output = finished(
                "world", "single", *reach, "-l", "tcp/127.0.0.1:0", timeout_s=60
            )
            assert (status, "has a world already" in output) == (2, True), output
        status, output = finished("command", "approach", "0", *reach, timeout_s=60)
        assert (status, output.startswith("accepted")) == (0, True), output
        status, output = finished("command", "approach", "0", *reach, timeout_s=60)
        assert (status, "already in phase approach" in output) == (0, True), output
        status, output = finished("command", "retreat", "9", *reach, timeout_s=60)
        assert (status, "there is no chaser 9" in output) == (1, True), output
        for name in ("world", "chaser/0", "chaser/1", "controller", "recorder"):
            status, output = by_hand.output_of(name)
            assert status == 0, f"{name}: {output}"
    finally:
        by_hand.end()
    flight = load_flight(log)
    assert len(flight.motion["target"].time_s) == 30 * 15 + 1
    assert {r.command: r.accepted for r in flight.replies} == {"approach": True, "retreat": False}
    reasons = {name.rpartition(":")[2] for name in flight.rejected}
    assert {
        "not_finite",
        "not_unit_quaternion",
        "format",
        "encoding",
        "chaser",
        "foreign publisher",
    } <= reasons


@pytest.mark.slow
def test_killed_recorder_leaves_readable_log(tmp_path: Path) -> None:
    """After SIGKILL of the recorder the flight completes. Which messages are then on the disk:
    tests/protocol/test_log_ends.py.
    """
    mission = chaserdock(
        "run", TWO, "--out", str(tmp_path / "run"), "-q", *sets(*LONG, "duration_s=30.0")
    )
    log = tmp_path / "run" / "mission.mcap"
    try:
        wait_for_log(log, FLYING_BYTES)
        find_child(mission, "record").kill()
        assert mission.wait(timeout=120) == 1
    finally:
        mission.kill()
        mission.wait()
    assert any(record.key == topics.TICK.key_of() for record in read_log(log))
    assert "completed" in (tmp_path / "run" / "processes" / "world.txt").read_text()
    result = summary(tmp_path / "run")
    assert not result["success"]
    assert result["failures"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "duration_s"), [(("controller",), 25.0), (("chaser", "1"), 14.0)]
)
def test_flight_continues_after_process_is_killed(
    victim: tuple[str, ...], duration_s: float, tmp_path: Path
) -> None:
    """Without a controller the chasers brake and hold, for which they need time; without one chaser
    the other continues.
    """
    length = sets(*LONG, f"duration_s={duration_s}")
    mission = chaserdock("run", TWO, "--out", str(tmp_path / "run"), "-q", *length)
    try:
        wait_for_log(tmp_path / "run" / "mission.mcap", FLYING_BYTES)
        find_child(mission, *victim).kill()
        assert mission.wait(timeout=180) == 1
    finally:
        mission.kill()
        mission.wait()
    result = summary(tmp_path / "run")
    name = "/".join(victim)
    assert any(f"process lost {name}" in e["what"] for e in result["events"])
    assert result["failures"][0] == f"{name}: killed (signal 9)"
    assert result["sim_time_s"] == duration_s
    assert result["collisions"] == 0
    flight = load_flight(tmp_path / "run" / "mission.mcap")
    ticks = [r.message for r in read_log(tmp_path / "run" / "mission.mcap", ["world/tick"])]
    if victim == ("controller",):
        assert not ticks[-1].controllers
        # A holding chaser moves with the target's velocity.
        apart = flight.motion["chaser/0"].velocity_m_s - flight.motion["target"].velocity_m_s
        speed = [float((v @ v) ** 0.5) for v in apart]
        assert speed[-1] < 0.2 * max(speed)
        states = [
            e.what
            for e in flight.events
            if e.process == "chaser/0" and e.what.startswith("fallback")
        ]
        assert states[-1] == "fallback: hold"
        assert states == [
            f"fallback: {what}"
            for what in ("plan", "brake", "hold")
            if f"fallback: {what}" in states
        ]
    else:
        assert ticks[-1].chasers == (0,)
        assert result["target_estimate"]["max_position_error_m"] < 0.01


@pytest.mark.slow
def test_frozen_chaser_that_was_replaced_ends_when_it_wakes(tmp_path: Path) -> None:
    """It commands no actuators beside its successor."""
    hand, lease = ByHand.at_free_port("replaced"), ("--lease", "10")
    single = (
        "world",
        "single",
        "--mode",
        "realtime",
        "--rejoin-timeout",
        "120",
        *sets(*SHORT, "duration_s=40.0"),
    )
    try:
        world = hand.start("world", *single, *lease)
        hand.start("recorder", "record", "--out", str(tmp_path), *lease)
        hand.start("controller", "controller", *lease)
        frozen = hand.start("frozen", "chaser", "0", *lease)
        wait_for_log(tmp_path / "mission.mcap", FLYING_BYTES)
        frozen.send_signal(signal.SIGSTOP)
        assert world.stdout is not None
        assert any(b"process lost: chaser/0" in line for line in world.stdout)
        hand.start("chaser", "chaser", "0", *lease)
        assert any(b"joined" in line for line in hand.processes["chaser"].stdout or ())
        time.sleep(2.0)
        frozen.send_signal(signal.SIGCONT)
        status, text = hand.output_of("frozen")
        assert status == 1
        assert "another chaser/0 has replaced this one, which was lost" in text
        assert hand.output_of("world")[0] == 0
        assert hand.output_of("recorder")[0] == 0
    finally:
        hand.end()
    instances = [
        r.message.instance for r in read_log(tmp_path / "mission.mcap", ["chaser/0/actuators"])
    ]
    first, last = instances[0], instances[-1]
    assert first != last
    # What it sends before it reads of its successor, the world rejects
    # (tests/protocol/test_tick_barrier.py).
    assert instances[instances.index(last) :].count(first) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_closes_log(how: signal.Signals, tmp_path: Path) -> None:
    mission = chaserdock("run", TWO, "--out", str(tmp_path / "run"), *sets(*LONG))
    log = tmp_path / "run" / "mission.mcap"
    try:
        wait_for_log(log, FLYING_BYTES)
        children = descendants(mission)
        mission.send_signal(how)
        assert mission.wait(timeout=60) == 130
    finally:
        mission.kill()
        mission.wait()
    assert all_gone(children)
    assert log.read_bytes().endswith(b"\x89MCAP0\r\n")  # the footer
    result = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result["failures"][0] == "stopped by the operator"
    assert result["ticks"] > 0


@pytest.mark.slow
def test_killed_launcher_leaves_no_processes(tmp_path: Path) -> None:
    mission = chaserdock("run", TWO, "--out", str(tmp_path / "run"), "-q", *sets(*LONG))
    log = tmp_path / "run" / "mission.mcap"
    children: list[psutil.Process] = []
    try:
        wait_for_log(log, FLYING_BYTES)
        children = descendants(mission)
        assert len(children) == 6  # with the fork server
        mission.kill()
        mission.wait()
        assert all_gone(children)
    finally:
        for child in psutil.process_iter():
            if child.pid in {c.pid for c in children}:
                child.kill()
    assert log.read_bytes().endswith(b"\x89MCAP0\r\n")


@pytest.mark.slow
def test_process_lost_before_first_tick_ends_run(tmp_path: Path) -> None:
    """The run ends with status 1 when a process fails before the first tick."""
    out = tmp_path / "run"
    out.mkdir()
    mission = chaserdock("run", TWO, "--out", str(out), "-q", *sets(*LONG))
    try:
        find_child(mission, "chaser", "1").kill()
        status = mission.wait(timeout=60)
    finally:
        mission.kill()
        mission.wait()
    assert status == 1


@pytest.mark.slow
def test_world_names_the_processes_that_do_not_connect() -> None:
    endpoint = f"tcp/127.0.0.1:{launcher.free_port()}"
    status, output = finished("world", "single", "-l", endpoint, "--timeout", "1.5", timeout_s=60)
    assert status == 1
    assert "not connected within 1.5 s: chaser/0, controller, recorder" in output


@pytest.mark.slow
def test_process_that_hangs_before_the_first_tick_ends_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = launcher.Fleet.start

    def start_suspended(
        self: launcher.Fleet, name: str, arguments: list[str], folder: Path
    ) -> None:
        start(self, name, arguments, folder)
        if name == "chaser/1":
            self.children[-1].process.send_signal(signal.SIGSTOP)

    monkeypatch.setattr(launcher.Fleet, "start", start_suspended)
    monkeypatch.setattr(launcher, "_START_TIMEOUT_S", 20)
    monkeypatch.setattr(launcher, "_END_TIMEOUT_S", 5.0)
    outcome = launcher.fly_mission(TWO, tmp_path / "run")
    assert outcome.status == 1
    assert outcome.failure is not None
    assert outcome.failure.startswith("not connected within 20 s: ")
    assert "chaser/1" in outcome.failure  # on a busy machine others may be late, too
