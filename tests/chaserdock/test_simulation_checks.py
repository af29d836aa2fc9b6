# SPDX-License-Identifier: Apache-2.0
"""Random cases, the invariants of simulated flights, and the reduction of failing cases."""

from __future__ import annotations

import copy
import itertools
import random
import re
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import (
    ActuatorCommand,
    BodyTruth,
    DockingStatus,
    DrawnBody,
    DrawnTruth,
    Event,
    MissionEnd,
    Plan,
    Reference,
    RelativeEstimate,
    Sighting,
    TargetEstimate,
    ThrusterPulse,
    ThrusterReport,
    Tick,
    WorldTruth,
    WrenchCommand,
    encoding_of,
)
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.faults import FAULTY_TOPICS, Fault, FaultKind, role_of
from chaserdock_protocol.scenario.thrusters import ThrusterFailure
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import RawSample
from harness import ROOT
from message_samples import BY_TYPE
from pydantic import ValidationError

from chaserdock.simulation.checks.check import Violation
from chaserdock.simulation.checks.commands import ThrustersOpen
from chaserdock.simulation.checks.docking import DockedOrSafe
from chaserdock.simulation.checks.estimates import FLIGHT_NEES, NEES
from chaserdock.simulation.checks.expectations import Expectation
from chaserdock.simulation.checks.flight_checks import CHECKS, FlightChecks
from chaserdock.simulation.checks.messages import covariance_defect, defects_of
from chaserdock.simulation.checks.processes import BoundedQueues, queue_limit
from chaserdock.simulation.checks.tracking import FLIGHT_TRACKING, TRACKING
from chaserdock.simulation.flight import SimulationResult
from chaserdock.simulation.links import Traffic
from chaserdock.simulation.mission import SimulatedFlight
from chaserdock.simulation.network import EPOCH_NS
from chaserdock.simulation.seeds import inaccuracies, shrink_result
from chaserdock.simulation.shrinking import shrink
from chaserdock.simulation.swarm import (
    KINDS,
    LATCH_KINDS,
    Case,
    draw_case,
    draw_fault,
)
from chaserdock.toml_text import toml_document

DRILL = ROOT / "scenarios" / "fault-drill.toml"
WEAK: dict[str, Any] = {"force_N": (0.25, -1.5, 1.0), "torque_N_m": (0.01, 0.0, -0.02)}
WRENCH: Any = msgspec.structs.replace(BY_TYPE[WrenchCommand], expires_ns=1_300_000_000, **WEAK)
ACTUATORS: Any = msgspec.structs.replace(BY_TYPE[ActuatorCommand], pulses=(), isolated=(), **WEAK)
WHILE = {"at_s": 1.0, "duration_s": 0.5}
EYE3 = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(DRILL)


def variant(folder: Path, **keys: Any) -> Scenario:
    """Return fault-drill with other values of ``keys``."""
    (folder / "case.toml").write_text(toml_document({"extends": "fault-drill", **keys}))
    return load_scenario(folder / "case.toml")


@pytest.fixture
def killed(tmp_path: Path) -> Scenario:
    """Scenario in which chaser 1 is killed."""
    return variant(tmp_path, fault=[{"kind": "kill", "process": "chaser/1", "at_s": 0.1}])


def test_recorder_may_be_the_window_of_ticks_behind() -> None:
    """Four chasers with ports and thrusters publish 54 messages a tick, 476 of which waited in
    `detumble`.
    """
    assert 476 < queue_limit("recorder", 1619, 30) < 600
    assert queue_limit("recorder", 300, 30) == queue_limit("world", 1619, 30) == 400


def test_messages_of_ticks_that_are_opened_at_once_may_wait() -> None:
    """Seed 357 of `fault-drill`: 459 messages of 30 ticks of a world that had been frozen waited
    for the recorder.
    """
    assert 459 < queue_limit("recorder", 3000, 250, missed_ticks=30) < 600
    assert queue_limit("controller", 3000, 250, missed_ticks=30) == 400
    assert queue_limit("controller", 30_000, 250, missed_ticks=30) == 3600


def judge_queues(log: Log, most: dict[str, int]) -> None:
    """Judge the most messages that have waited in each queue, of a flight of 5,000."""
    log.checks.view.published = Counter({"messages": 5000})
    queues: Any = {name: SimpleNamespace(most=number) for name, number in most.items()}
    flight = SimulatedFlight(Path(), {}, {}, (), "", 25.0, Traffic(queues=queues))
    log.checks.find(BoundedQueues).end(flight)


@pytest.mark.parametrize(
    ("keys", "readers"),
    [
        ({}, {"world", "controller", "chaser/0", "chaser/1", "recorder"}),
        (
            {"fault": [{"kind": "freeze", "process": "chaser/1", **WHILE}]},
            {"world", "controller", "chaser/0", "recorder"},
        ),
        (
            {
                "fault": [
                    {
                        "kind": "flood",
                        "process": "chaser/0",
                        "topic": "sighting",
                        "copies": 5,
                        **WHILE,
                    }
                ]
            },
            {"world", "chaser/0", "chaser/1"},
        ),
        (
            {"simulation": {"slow": [{"process": "recorder", "each_s": 0.01, **WHILE}]}},
            {"world", "controller", "chaser/0", "chaser/1"},
        ),
        (
            {"simulation": {"partition": [{"processes": ["chaser/0"], **WHILE}]}},
            {"world", "controller", "chaser/1", "recorder"},
        ),
    ],
)
def test_queues_grow_for_a_reader_that_falls_behind_only(
    keys: dict[str, Any], readers: set[str], tmp_path: Path
) -> None:
    log = Log(variant(tmp_path, **keys))
    log.tick(249)
    names = ("world", "controller", "chaser/0", "chaser/1", "recorder")
    judge_queues(log, {f"{name} {k}": 1000 for k, name in enumerate(names)})
    assert {v.text.split(":")[0] for v in log.checks.violations} == readers


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ({}, ["bounded queues"]),
        (
            {"simulation": {"slow": [{"process": "controller", "each_s": 0.02, **WHILE}]}},
            ["bounded queues"],
        ),
        (
            {
                "simulation": {
                    "slow": [
                        {"process": "controller", "each_s": 0.02, "at_s": 7.9, "duration_s": 5.1}
                    ]
                }
            },
            [],
        ),
        ({"fault": [{"kind": "freeze", "process": "world", "at_s": 1.0, "duration_s": 3.0}]}, []),
    ],
    ids=["nothing", "short", "slow", "frozen"],
)
def test_queue_of_the_recorder_grows_while_a_process_catches_up(
    keys: dict[str, Any], found: list[str], tmp_path: Path
) -> None:
    """Seed 1745 of `fault-drill`: the controller replied to the ticks of 5 s at once."""
    simulation = {"mode": "realtime"} | keys.get("simulation", {})
    log = Log(variant(tmp_path, **keys | {"simulation": simulation}))
    log.tick(249)
    judge_queues(log, {"recorder 0": 469})
    assert log.found == found


# -- cases -----------------------------------------------------------------------------------------


def test_seeds_draw_valid_scenarios_with_all_kinds_of_faults(
    scenario: Scenario, tmp_path: Path
) -> None:
    kinds, modes, sections = set(), set(), set()
    for seed in range(150):
        case = draw_case("fault-drill", seed, scenario)
        assert case == draw_case("fault-drill", seed, scenario)
        path = tmp_path / "case.toml"
        path.write_text(toml_document(case))
        loaded = load_scenario(path)
        assert [f.kind for f in loaded.fault] == [f["kind"] for f in case["fault"]]
        assert loaded.simulation.model_dump(exclude_unset=True).keys() == case["simulation"].keys()
        assert loaded.perception.name == "statistical"
        kinds |= {f.kind for f in loaded.fault}
        modes.add(loaded.simulation.mode)
        sections |= case.keys() | case["simulation"].keys()
    assert kinds == set(KINDS)
    assert modes == {"lockstep", "realtime"}
    assert sections >= {
        "truth",
        "timeline",
        "partition",
        "slow",
        "clock",
        "loss",
        "duplicate",
        "reorder",
    }


@pytest.mark.parametrize(
    "path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.stem
)
def test_seeds_draw_valid_variants_of_every_shipped_scenario(path: Path, tmp_path: Path) -> None:
    base = load_scenario(path)
    for seed in range(15):
        case = draw_case(path.stem, seed, base, images=not base.target_model().markers)
        (tmp_path / "case.toml").write_text(toml_document(case))
        load_scenario(tmp_path / "case.toml")


def test_one_seed_in_four_has_the_time_to_dock_after_its_last_disturbance(
    scenario: Scenario,
) -> None:
    ends_s = {
        seed: draw_case("fault-drill", seed, scenario).get("duration_s", 25.0) for seed in range(40)
    }
    assert {seed for seed, end_s in ends_s.items() if end_s > 25.0} == set(range(0, 40, 4))
    for seed in range(0, 40, 4):
        case = draw_case("fault-drill", seed, scenario)
        rows = [*case["fault"], *case.get("timeline", []), *case["simulation"].get("partition", [])]
        last_s = max([5.0, *(row["at_s"] + row.get("duration_s", 0.0) for row in rows)])
        assert last_s + 30.0 < ends_s[seed] < 80.0


def test_seeds_draw_faults_of_latches_where_there_are_ports(tmp_path: Path) -> None:
    base = load_scenario(ROOT / "scenarios" / "four-chaser-capture.toml")
    kinds, chasers = set(), set()
    for seed in range(60):
        case = draw_case("four-chaser-capture", seed, base)
        path = tmp_path / "case.toml"
        path.write_text(toml_document(case))
        faults = [f for f in load_scenario(path).fault if f.kind in LATCH_KINDS]
        kinds |= {f.kind for f in faults}
        chasers |= {f.process for f in faults}
    assert kinds == set(LATCH_KINDS)
    assert chasers <= {f"chaser/{port.chaser}" for port in base.docking.ports}
    assert len(chasers) > 1


def test_seeds_draw_thruster_failures_and_lost_device_messages_where_there_are_any(
    tmp_path: Path,
) -> None:
    capture = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    kinds, topics_of = set(), set()
    for seed in range(60):
        case = draw_case("docking-contact", seed, capture)
        path = tmp_path / "case.toml"
        path.write_text(toml_document(case))
        loaded = load_scenario(path)
        kinds |= {f.kind for f in loaded.thruster_failure}
        lost = [
            f for f in loaded.fault if f.topic in ("docking", "thrusters") and f.kind != "flood"
        ]
        topics_of |= {(f.process, f.topic) for f in lost}
    assert kinds == {"stuck_off", "stuck_on", "weak"}
    assert topics_of == {
        ("controller", "thrusters"),
        ("controller", "docking"),
        ("chaser/0", "docking"),
    }


def documented_faults() -> set[str]:
    """Return the kinds in the table of docs/faults.md."""
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    table = text.partition("| kind | effect |")[2].partition("\n\n")[0]
    return set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE))


def possible_faults() -> set[tuple[str, str, str]]:
    """Return kind, role and topic of every fault that a mission with ports and thrusters can have;
    topic: empty if it has none."""
    possible = set()
    for kind in get_args(FaultKind):
        drawn = draw_fault(kind, random.Random(0), 1, ports=(0,))
        keys = {
            name: value for name, value in drawn.items() if name not in ("process", "peer", "topic")
        }
        for process, topic in itertools.product(
            ("world", "controller", "chaser/0", "recorder"), ("", *FAULTY_TOPICS)
        ):
            with suppress(ValidationError):
                Fault.model_validate(
                    keys | {"process": process} | ({"topic": topic} if topic else {})
                )
                possible.add((kind, role_of(process), topic))
    return possible


def test_seeds_draw_every_documented_fault_of_every_message() -> None:
    capture = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    drawn = set()
    for seed in range(3000):
        for fault in draw_case("docking-contact", seed, capture)["fault"]:
            drawn.add((fault["kind"], role_of(fault["process"]), fault.get("topic", "")))
    assert documented_faults() == set(get_args(FaultKind))
    assert drawn == possible_faults()


def test_a_case_without_timeline_overrides_that_of_its_base(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    path.write_text(
        toml_document({"extends": "fault-drill", "timeline": [], "success": {"docked": []}})
    )
    assert load_scenario(path).timeline == ()


# -- invariants ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_documentation_is_that_of_the_checks() -> None:
    command = [sys.executable, str(ROOT / "docs" / "make_invariants.py"), "--print"]
    made = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    committed = (ROOT / "docs" / "invariants.md").read_text(encoding="utf-8")
    assert committed == made, "run: python docs/make_invariants.py"


def test_few_rules_have_more_than_three_exceptions() -> None:
    """Where one would need a fourth, ask first whether the rule or the flight software is wrong."""
    many = {check.__name__ for check in CHECKS if len(check.exceptions) > 3}
    assert many == {"KeepOutZone", "ThrustersAsExpected"}


class Log:
    """Publishes messages to the invariants of a scenario."""

    def __init__(self, scenario: Scenario) -> None:
        self.checks = FlightChecks(scenario)
        self.now_s = 0.0

    def publish(
        self, topic: Topic, message: Any, place: int | str | None = None, sender: str = "world"
    ) -> None:
        raw = RawSample(
            topic.key_of(place),
            encoding_of(topic.kind),
            codec.encode(message),
            EPOCH_NS + round(self.now_s * 1e9),
        )
        self.checks.observe(sender, raw)

    def tick(self, tick: int, chasers: tuple[int, ...] = (0, 1, 2, 3), **changes: Any) -> None:
        at: dict[str, Any] = {"tick": tick, "sim_time_ns": tick * 100_000_000, **changes}
        self.publish(topics.TICK, msgspec.structs.replace(BY_TYPE[Tick], chasers=chasers, **at))

    def bodies(
        self, tick: int, *bodies: BodyTruth, contacts: tuple[tuple[str, str], ...] = ()
    ) -> None:
        for body in bodies:
            stamped = msgspec.structs.replace(body, tick=tick, sim_time_ns=tick * 100_000_000)
            self.publish(topics.TRUTH_BODY, stamped, body.body)
        self.touch(tick, *contacts)
        self.tick(tick)

    def touch(self, tick: int, *contacts: tuple[str, str]) -> None:
        self.publish(topics.TRUTH_WORLD, WorldTruth(tick=tick, contacts=contacts, saturated=()))

    def flies(self, chaser: int, tick: int, term: int = 1, source: str = "command") -> None:
        command = msgspec.structs.replace(
            ACTUATORS, chaser=chaser, tick=tick, term=term, source=source
        )
        self.publish(topics.ACTUATORS, command, chaser, f"chaser/{chaser}")

    def event(self, what: str, detail: str, process: str = "world", level: Any = "warning") -> None:
        self.publish(
            topics.EVENT, Event(process=process, level=level, what=what, detail=detail), process
        )

    def end(self, crashes: dict[str, str] | None = None, stalled: tuple[str, ...] = ()) -> None:
        flight = SimulatedFlight(Path(), {}, crashes or {}, stalled, "", 25.0, Traffic())
        self.checks.end(flight)

    def state(self, chaser: int) -> str:
        return self.checks.find(DockedOrSafe).state_of(chaser)

    @property
    def found(self) -> list[str]:
        return [v.invariant for v in self.checks.violations]


@pytest.fixture
def log(scenario: Scenario) -> Log:
    return Log(scenario)


def body(name: str, x_m: float, speed_m_s: float = 0.0, **values: Any) -> BodyTruth:
    state = {
        "velocity_m_s": (speed_m_s, 0.0, 0.0),
        "q_wxyz": (1.0, 0.0, 0.0, 0.0),
        "omega_rad_s": (0.0, 0.0, 0.1),
    }
    return BodyTruth(body=name, position_m=(x_m, 0.0, 0.0), **{**state, **values})


def test_contact_is_a_violation_unless_a_chaser_is_lost(killed: Scenario) -> None:
    log = Log(killed)
    log.tick(1)
    log.event("process lost", "chaser/1")
    log.bodies(1, contacts=(("chaser/1", "target"),))
    assert log.found == []
    log.bodies(2, contacts=(("chaser/0", "chaser/2"),))
    log.bodies(3, contacts=(("chaser/0", "chaser/2"),))
    assert log.found == ["no contact"]
    assert "0.20 s: chaser/0 and chaser/2" in str(log.checks.violations[0])


def test_keep_out_zones_surround_target_and_chasers(log: Log) -> None:
    log.bodies(1, body("target", 0.0), body("chaser/0", 0.34), body("chaser/1", 0.70))
    assert log.found == []
    log.bodies(3, body("target", 0.0), body("chaser/0", 0.32), body("chaser/1", 0.64))
    assert log.found == ["keep-out zone", "keep-out zone"]


@pytest.mark.parametrize(("liars", "found"), [(1, ["no contact", "keep-out zone"]), (2, [])])
def test_distances_are_not_judged_while_half_of_the_sensors_lie(
    liars: int, found: list[str], tmp_path: Path
) -> None:
    lies = [
        {"kind": "lying_sensor", "process": f"chaser/{i}", "offset_m": [0.2, 0.0, 0.0], **WHILE}
        for i in range(liars)
    ]
    log = Log(variant(tmp_path, fault=lies))
    log.bodies(12, body("target", 0.0), body("chaser/2", 0.2), contacts=(("chaser/3", "target"),))
    assert log.found == found
    log.bodies(200, body("target", 0.0), body("chaser/2", 0.2))
    assert log.found == (found or ["keep-out zone"])


@pytest.mark.parametrize("lost", [False, True])
def test_a_chaser_that_flies_commands_again_is_judged_again(killed: Scenario, lost: bool) -> None:
    """From 3 s of flown commands on, and of a process that was lost, only if it takes part
    again.
    """
    log = Log(killed)
    log.tick(5)
    log.event(
        *(("process lost", "chaser/1") if lost else ("actuators stopped", "chaser/1: no command"))
    )
    for tick in range(6, 100):
        log.tick(tick, chasers=(0, 2, 3) if lost and tick < 50 else (0, 1, 2, 3))
        log.flies(1, tick, source="command" if tick >= 20 else "hold")
        log.touch(tick, ("chaser/1", "target"))
        if log.found:
            break
    assert [v.time_s for v in log.checks.violations] == [8.1 if lost else 5.1]


@pytest.mark.parametrize(
    ("along_m", "aside_m", "found"),
    [(0.6, 0.0, []), (0.6, 0.3, ["keep-out zone"]), (-0.6, 0.0, ["keep-out zone"])],
)
def test_a_chaser_comes_nearer_in_the_corridor_of_its_port_only(
    along_m: float, aside_m: float, found: list[str]
) -> None:
    capture = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    log, axis = Log(capture), np.array(capture.docking.ports[0].axis)
    aside = np.cross(axis, (0.0, 0.6, 0.8))
    q = rotations.exp(np.array((0.0, 0.0, 0.5)))
    at = rotations.rotate(q, along_m * axis + aside_m * aside / np.linalg.norm(aside))
    log.bodies(
        1,
        body("target", 0.0, q_wxyz=tuple(q.tolist())),
        msgspec.structs.replace(body("chaser/0", 0.0), position_m=tuple(at.tolist())),
    )
    assert log.found == found


def test_momentum_changes_by_impulses_only(log: Log) -> None:
    drawn = DrawnBody(body="chaser/0", mass_kg=10.0, inertia_kg_m2=(1.0,) * 9)
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=(drawn,)))
    pushed = {"impulse_N_s": (0.1, 0.0, 0.0), "absolute_impulse_N_s": 0.1}
    log.bodies(1, body("chaser/0", 2.0))
    log.bodies(2, body("chaser/0", 2.0, 0.01, **pushed))
    assert log.found == []
    log.bodies(3, body("chaser/0", 2.0015, 0.02))
    assert log.found == ["momentum"]


def test_angular_momentum_changes_by_angular_impulses_only(log: Log) -> None:
    drawn = DrawnBody(
        body="chaser/0", mass_kg=10.0, inertia_kg_m2=(1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0)
    )
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=(drawn,)))
    log.bodies(1, body("chaser/0", 2.0))
    turned: dict[str, Any] = {
        "omega_rad_s": (0.0, 0.0, 0.2),
        "angular_impulse_N_m_s": (0.0, 0.0, 0.1),
    }
    log.bodies(2, body("chaser/0", 2.0, **turned))
    assert log.found == []
    log.bodies(3, body("chaser/0", 2.0, omega_rad_s=(0.0, 0.0, 0.3)))
    assert log.found == ["angular momentum"]


def test_positions_follow_velocities(log: Log) -> None:
    log.bodies(1, body("chaser/0", 2.0, 0.1))
    log.bodies(2, body("chaser/0", 2.01, 0.1))
    assert log.found == []
    log.bodies(3, body("chaser/0", 2.019, 0.1))
    assert log.found == ["displacement"]


def test_a_probe_in_contact_may_change_the_momentum(log: Log) -> None:
    """Also without a new touch, as after a latch has opened: the docking sensor reports it in the
    same tick.
    """
    drawn = DrawnBody(body="chaser/0", mass_kg=10.0, inertia_kg_m2=(1.0,) * 9)
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=(drawn,)))
    log.bodies(1, body("chaser/0", 2.0))
    for tick, contact in ((2, True), (3, False)):
        status = DockingStatus(tick=tick, chaser=0, contact=contact, armed=False, latched=False)
        log.publish(topics.DOCKING, status, 0)
        log.bodies(tick, body("chaser/0", 2.0, 0.01 * (tick - 1)))
        assert ("momentum" in log.found) != contact


def test_bodies_begin_where_the_scenario_states(log: Log, scenario: Scenario) -> None:
    position, q = scenario.start_pose(0)
    there = {"position_m": tuple(position.tolist()), "q_wxyz": tuple(q.tolist())}
    start = msgspec.structs.replace(body("chaser/0", 0.0), **there)
    log.bodies(0, start)
    assert log.found == []
    other = Log(scenario)
    other.bodies(0, msgspec.structs.replace(start, q_wxyz=(0.0, 1.0, 0.0, 0.0)))
    assert other.found == ["initial state"]


def test_a_chaser_is_lost_for_a_cause_only(killed: Scenario, scenario: Scenario) -> None:
    with_cause, without = Log(killed), Log(scenario)
    for log in (with_cause, without):
        log.tick(2)
        log.event("actuators stopped", "chaser/1: no command for 0.5 s")
    assert with_cause.found == []
    assert without.found == ["no loss without a cause"]


@pytest.mark.parametrize(("jitter_s", "found"), [(0.002, ["no loss without a cause"]), (0.01, [])])
def test_leases_may_run_out_in_a_network_that_is_slow_against_a_tick(
    jitter_s: float, found: list[str], tmp_path: Path
) -> None:
    log = Log(variant(tmp_path, simulation={"mode": "realtime", "jitter_s": jitter_s}))
    log.tick(2)
    log.event("actuators stopped", "chaser/1: no command for 0.5 s")
    assert log.found == found


def test_published_commands_are_flown_unless_a_fault_lasts(tmp_path: Path) -> None:
    drop = {
        "kind": "drop",
        "process": "chaser/1",
        "topic": "wrench",
        "at_s": 1.0,
        "duration_s": 4.0,
    }
    blind = {"kind": "camera_off", "process": "chaser/1", "at_s": 1.0, "duration_s": 6.0}
    log = Log(
        variant(tmp_path, fault=[drop, blind, {**drop, "process": "chaser/2", "duration_s": 6.0}])
    )
    for tick in range(82):
        assert log.found == [], tick
        log.tick(tick)
        for chaser in (0, 1):
            commanded = msgspec.structs.replace(WRENCH, chaser=chaser, tick=tick, mode="nmpc")
            log.publish(topics.WRENCH, commanded, chaser, "controller")
        log.flies(0, tick)
        log.flies(1, tick, source="command" if tick < 10 else "hold")
    assert [str(v) for v in log.checks.violations] == [
        "commands are flown at 8.10 s: chaser/1: has flown no command for 3.1 s, but commands are "
        "published"
    ]


def test_a_retreat_leads_away_from_the_target(log: Log) -> None:
    sample: Any = msgspec.structs.replace(BY_TYPE[Reference], chaser=0)

    def refers(phase: str, x_m: float) -> None:
        reference = msgspec.structs.replace(sample, phase=phase, offset_m=(x_m, 0.0, 0.0))
        log.publish(topics.REFERENCE, reference, 0)

    for phase, x_m in (("approach", -0.5), ("retreat", -0.45), ("retreat", -0.42), ("hold", -0.1)):
        refers(phase, x_m)
    assert log.found == []
    refers("abort", -0.5)
    refers("abort", -0.3)
    assert log.found == ["retreat leads away"]


def test_a_retreat_leads_to_the_nominal_place_when_it_has_turned(log: Log) -> None:
    sample: Any = msgspec.structs.replace(BY_TYPE[Reference], chaser=0, phase="retreat")
    for time_s, x_m in ((1.0, -0.50), (4.0, -0.44), (6.0, -0.48), (7.0, -0.50), (8.0, -0.48)):
        reference = msgspec.structs.replace(sample, phase_time_s=time_s, offset_m=(x_m, 0.0, 0.0))
        log.publish(topics.REFERENCE, reference, 0)
    assert log.found == []
    log.publish(
        topics.REFERENCE,
        msgspec.structs.replace(sample, phase_time_s=9.0, offset_m=(-0.46, 0, 0)),
        0,
    )
    assert log.found == ["retreat leads away"]


def test_a_retreat_leads_to_the_entry_of_the_corridor_for_another_attempt() -> None:
    """Seed 502 of `abort`: from 1.07 m, past the nominal place at 1 m, to the entry at 0.9 m."""
    log = Log(load_scenario(ROOT / "scenarios" / "docking-contact.toml"))
    sample: Any = msgspec.structs.replace(BY_TYPE[Reference], chaser=0, phase="retreat")
    for found, places_m in (([], (-1.07, -1.0, -0.9)), (["retreat leads away"], (-0.86,))):
        for k, x_m in enumerate(places_m):
            at = {"phase_time_s": 6.0 + k, "offset_m": (x_m, 0.0, -0.05)}
            log.publish(topics.REFERENCE, msgspec.structs.replace(sample, **at), 0)
        assert log.found == found


def test_commands_are_the_inputs_of_their_plans(log: Log) -> None:
    inputs = (*WRENCH.force_N, *WRENCH.torque_N_m, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    sample: Any = BY_TYPE[Plan]
    plan = msgspec.structs.replace(
        sample, positions_m=(0.0,) * 9, quaternions_wxyz=(1.0, 0, 0, 0) * 3, inputs=inputs
    )
    log.publish(topics.PLAN, plan, 0)
    acting = msgspec.structs.replace(WRENCH, effective_time_ns=plan.sim_time_ns + 50_000_000)
    log.publish(topics.WRENCH, acting, 0)
    log.publish(
        topics.WRENCH, msgspec.structs.replace(acting, mode="track", force_N=(0.0, 0.0, 0.0)), 0
    )
    assert log.found == []
    late = msgspec.structs.replace(acting, effective_time_ns=plan.sim_time_ns + 150_000_000)
    log.publish(topics.WRENCH, late, 0)
    assert log.found == ["plan is flown"]


def test_a_lying_sensor_does_not_mislead_the_estimate_of_two_others(tmp_path: Path) -> None:
    lie = {"kind": "lying_sensor", "at_s": 1.0, "duration_s": 9.0, "offset_m": [0.2, 0.0, 0.0]}
    logs = [
        Log(variant(tmp_path, fault=[{**lie, "process": f"chaser/{i}"} for i in liars]))
        for liars in ((2,), (1, 2))
    ]
    sample: Any = BY_TYPE[TargetEstimate]
    for log in logs:
        log.bodies(9, body("target", 0.0))
        for chaser in range(3):
            sighting: Any = msgspec.structs.replace(BY_TYPE[Sighting], chaser=chaser)
            log.publish(topics.SIGHTING, sighting, chaser)
        for x_m in (0.005, 0.015):
            estimate = msgspec.structs.replace(
                sample, tick=9, sim_time_ns=900_000_000, position_m=(x_m, 0.0, 0.0)
            )
            log.publish(topics.TARGET, estimate)
    assert [log.found for log in logs] == [["accurate estimate"], []]


@pytest.mark.parametrize(("reported", "latched"), [(False, True), (True, True), (False, False)])
def test_estimate_is_not_judged_while_a_thruster_pushes_the_target_unknown_to_all(
    reported: bool, latched: bool
) -> None:
    s = load_scenario(find_scenario("four-chaser-capture"))
    failure = ThrusterFailure(chaser=0, thruster=3, at_s=0.5, kind="stuck_on", reported=reported)
    log, sample = (
        Log(s.model_copy(update={"thruster_failure": (failure,)})),
        BY_TYPE[TargetEstimate],
    )
    held = WorldTruth(tick=15, contacts=(), saturated=(), latched=(0,) if latched else ())
    stamps: Any = {"tick": 15, "sim_time_ns": 1_000_000_000}
    log.publish(topics.TRUTH_BODY, msgspec.structs.replace(body("target", 0.0), **stamps), "target")
    log.publish(topics.TRUTH_WORLD, held)
    for chaser in range(3):
        sighting: Any = msgspec.structs.replace(BY_TYPE[Sighting], chaser=chaser)
        log.publish(topics.SIGHTING, sighting, chaser)
    estimate: Any = msgspec.structs.replace(sample, position_m=(0.015, 0.0, 0.0), **stamps)
    log.publish(topics.TARGET, estimate)
    assert log.found == ([] if latched and not reported else ["accurate estimate"])


@pytest.mark.parametrize(
    ("fault", "event", "found"),
    [
        ({}, "no reason", ["damage is named"]),
        ({}, "chaser 2: invalid sighting, ignored: covariance is not symmetric", []),
        ({"share": 0.3}, "no reason", []),
        ({"peer": "chaser/1"}, "no reason", []),
        ({"duration_s": 2.0}, "no reason", []),
    ],
)
def test_a_controller_names_damaged_sightings(
    fault: dict[str, Any], event: str, found: list[str], tmp_path: Path
) -> None:
    """Where it receives enough of them for one that is an invalid pose."""
    damage = {
        "kind": "corrupt",
        "process": "controller",
        "topic": "sighting",
        "at_s": 1.0,
        "duration_s": 9.0,
    }
    log = Log(variant(tmp_path, fault=[{**damage, **fault}]))
    for tick in range(60):
        log.bodies(tick)
        log.flies(0, tick)
        for chaser in range(4):
            sighting: Any = msgspec.structs.replace(BY_TYPE[Sighting], chaser=chaser, tick=tick)
            for _ in range(2):  # a copy of a flood counts once
                log.publish(topics.SIGHTING, sighting, chaser)
    log.event(event, "", "controller")
    ended(log).end()
    assert [name for name in log.found if name != "liveness"] == found


@pytest.mark.parametrize("cut_s", [(), (0.3,)])
def test_thrusters_give_what_the_chaser_expects(cut_s: tuple[float, ...], tmp_path: Path) -> None:
    """Except after a partition, in which the world gets no pulses."""
    cut = [{"processes": ["chaser/0"], "at_s": t, "duration_s": 0.1} for t in cut_s]
    network = {"mode": "realtime", "partition": cut}
    log = Log(variant(tmp_path, extends="docking-contact", simulation=network))
    sample: Any = BY_TYPE[ThrusterReport]
    report = msgspec.structs.replace(
        sample,
        force_max_N=(0.5,) * 3,
        torque_max_N_m=(0.01,) * 3,
        thrusters=("healthy",) * 12,
        given_impulse_N_s=(0.1, 0.0, 0.0),
    )
    for tick in range(1, 12):
        fired: dict[str, Any] = {"impulse_N_s": (0.1 if tick < 10 else -0.1, 0.0, 0.0)}
        log.bodies(tick, body("chaser/0", 2.0, **fired, thruster_impulse_N_s=(0.1,)))
        at = {"tick": tick, "sim_time_ns": tick * 100_000_000}
        log.publish(topics.THRUSTERS, msgspec.structs.replace(report, **at), 0)
        found = [name for name in log.found if name != "valid messages"]
        assert found == ([] if tick < 10 or cut_s else ["thrusters as expected"]), tick


def test_a_healthy_thruster_is_not_suspected(tmp_path: Path) -> None:
    """Except where pulses may be late: the chaser cannot know what they lose."""
    weak: Any = msgspec.structs.replace(BY_TYPE[ThrusterReport], thrusters=("healthy", "weak"))
    for jitter_s, found in ((0.001, ["thrusters as expected"]), (0.01, [])):
        log = Log(variant(tmp_path, simulation={"mode": "realtime", "jitter_s": jitter_s}))
        log.publish(topics.THRUSTERS, weak, 0)
        assert [name for name in log.found if name != "valid messages"] == found


@pytest.mark.parametrize(("pause", "found"), [(1000, ["liveness"]), (150, [])])
def test_a_chaser_without_a_controller_comes_to_rest(
    log: Log, pause: int, found: list[str]
) -> None:
    for tick in range(250):
        log.tick(tick)
        log.flies(0, tick, source="hold" if tick == pause else "brake")
    assert [name for name in log.found if name != "commands are flown"] == found


@pytest.mark.parametrize(("every", "found"), [(10, []), (100, ["commands are flown"])])
def test_commanded_force_opens_thrusters(every: int, found: list[str]) -> None:
    """Twelve thrusters of 1.5 N give 1.8 N s in a carrier period; 1.5 N for 30 ticks of 15 Hz are 3
    N s.
    """
    log = Log(load_scenario(ROOT / "scenarios" / "docking-contact.toml"))
    push: Any = msgspec.structs.replace(
        ACTUATORS, chaser=0, force_N=(1.5, 0.0, 0.0), torque_N_m=(0.0,) * 3
    )
    pulse = ThrusterPulse(thruster=0, open_ns=0, close_ns=100_000_000)
    thrusters_open = log.checks.find(ThrustersOpen)
    for tick in range(30):
        pulses = () if tick % every else (pulse,)
        for _ in range(3):  # copies of a flood count once
            thrusters_open.judge(msgspec.structs.replace(push, tick=tick, pulses=pulses))
    assert log.found == found


@pytest.mark.parametrize(("phase", "found"), [("verified", ["latch holds"]), ("retreat", [])])
def test_a_latch_opens_for_a_retreat_only(log: Log, phase: str, found: list[str]) -> None:
    for tick, latched in ((1, (0,)), (2, ())):
        reference: Any = msgspec.structs.replace(BY_TYPE[Reference], phase=phase)
        log.publish(topics.REFERENCE, reference, 0)
        log.publish(
            topics.TRUTH_WORLD, WorldTruth(tick=tick, contacts=(), saturated=(), latched=latched)
        )
    assert log.found == found


def test_an_untouched_target_conserves_its_energy(log: Log) -> None:
    drawn = DrawnBody(body="target", mass_kg=1.0, inertia_kg_m2=(1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0))
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=(drawn,)))
    for tick, rate in enumerate((0.1, 0.1, 0.1, 0.11), start=1):
        log.bodies(tick, body("target", 0.01 * tick, 0.1, omega_rad_s=(0.0, 0.0, rate)))
    assert log.found == ["energy and momentum"]


def test_a_touched_target_may_change_its_energy(log: Log) -> None:
    drawn = DrawnBody(body="target", mass_kg=1.0, inertia_kg_m2=(1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0))
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=(drawn,)))
    for tick, rate in enumerate((0.1, 0.2, 0.2)):
        turning = body("target", 0.01 * tick, 0.1, omega_rad_s=(0.0, 0.0, rate), tick=tick)
        log.publish(topics.TRUTH_BODY, turning, "target")
        latched = (0,) if tick == 1 else ()
        log.publish(
            topics.TRUTH_WORLD, WorldTruth(tick=tick, contacts=(), saturated=(), latched=latched)
        )
    assert log.found == []


@pytest.mark.parametrize(
    ("phase", "rates", "found"),
    [
        ("detumble", (0.4, 0.2, 0.1, 0.2), ["tumble falls"]),
        ("stack_hold", (0.4, 0.0, 0.0, 0.1), ["tumble falls"]),
        ("detumble", (0.4, 0.2, 0.21, 0.0), []),
        ("verified", (0.1, 0.1, 0.1, 0.2), []),
    ],
)
def test_latched_chasers_do_not_spin_the_stack_up(
    log: Log, phase: str, rates: tuple[float, ...], found: list[str]
) -> None:
    """The chaser is 1 m from the target: both turn about their common centre of mass."""
    drawn = [
        DrawnBody(body=name, mass_kg=2.0, inertia_kg_m2=(1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0))
        for name in ("target", "chaser/0")
    ]
    log.publish(topics.TRUTH_DRAWN, DrawnTruth(bodies=tuple(drawn)))
    reference: Any = msgspec.structs.replace(BY_TYPE[Reference], phase=phase)
    log.publish(topics.REFERENCE, reference, 0)
    for tick, rate in enumerate(rates):
        for name, x_m in (("target", 0.0), ("chaser/0", -1.0)):
            moving: dict[str, Any] = {
                "omega_rad_s": (0, 0, rate),
                "velocity_m_s": (0, rate * (x_m + 0.5), 0),
            }
            log.publish(topics.TRUTH_BODY, body(name, x_m, **moving, tick=tick), name)
        log.publish(
            topics.TRUTH_WORLD, WorldTruth(tick=tick, contacts=(), saturated=(), latched=(0,))
        )
    assert log.found == found


def test_flown_commands_are_neither_old_nor_superseded(log: Log) -> None:
    log.tick(20)
    log.flies(0, 20)
    log.flies(0, 19, source="brake")
    log.flies(1, 16)
    assert log.found == []
    log.flies(1, 10)
    assert log.found == ["no stale command"]
    log.flies(0, 21, term=3)
    log.flies(0, 22, term=1)
    assert log.found[1:] == ["no superseded command"]


def test_commands_may_be_older_than_the_ticks_that_a_frozen_world_opens_at_once(
    tmp_path: Path,
) -> None:
    log = Log(variant(tmp_path, simulation={"mode": "realtime", "latency_s": 0.01}))
    log.now_s = 1.0
    log.tick(20)
    log.now_s = 4.0
    for tick in range(21, 51):
        log.tick(tick)
    log.now_s = 4.1
    log.flies(0, 20)
    assert log.found == []
    log.now_s = 4.12
    log.flies(1, 20)
    assert log.found == ["no stale command"]


def test_chasers_fly_different_commanders_only_in_a_tick_in_which_a_controller_is_lost(
    killed: Scenario,
) -> None:
    log = Log(killed)
    log.tick(20, controllers={"controller": "c", "standby": "s"})
    log.flies(1, 20, term=1)
    log.tick(20, revision=1, controllers={"standby": "s"})
    log.flies(0, 20, term=2)
    log.tick(21, controllers={"standby": "s"})
    log.flies(0, 21, term=2)
    log.flies(1, 21, term=4)
    assert log.found == []
    log.tick(22, controllers={"controller": "c", "standby": "s"})
    log.flies(1, 22, term=5)
    log.tick(22, revision=1, chasers=(0,), controllers={"controller": "c", "standby": "s"})
    log.flies(0, 22, term=4)
    assert log.found == ["one commander"]


def test_controllers_do_not_command_in_turn(killed: Scenario) -> None:
    """A command that is flown late, and one of a tick in which a controller is lost, may be of the
    former commander.
    """
    log = Log(killed)
    log.tick(21, controllers={"controller": "c", "standby": "s"})
    log.tick(21, revision=1, controllers={"standby": "s"})
    for chaser, tick, term in ((0, 20, 1), (1, 21, 2), (2, 20, 1), (3, 21, 1)):
        log.flies(chaser, tick, term)
    assert log.found == []
    log.tick(22)
    log.flies(3, 22, term=1)
    assert log.found == ["one commander"]
    other = Log(killed)
    other.tick(22)
    other.flies(3, 22, term=1)
    other.flies(1, 21, term=2)
    assert other.found == ["one commander"]


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ({}, True),
        ({"simulation": {"mode": "realtime", "jitter_s": 0.001}}, True),
        ({"simulation": {"mode": "realtime", "loss": 0.01}}, False),
        ({"simulation": {"mode": "realtime", "jitter_s": 0.01}}, False),
        (
            {
                "simulation": {
                    "partition": [{"at_s": 1.0, "duration_s": 1.5, "processes": ["chaser/0"]}]
                }
            },
            False,
        ),
        ({"fault": [{"kind": "kill", "process": "controller", "at_s": 4.5}]}, False),
        ({"fault": [{"kind": "kill", "process": "chaser/1", "at_s": 0.5}]}, True),
        ({"fault": [{"kind": "kill", "process": "controller", "at_s": 5.5}]}, True),
        (
            {
                "fault": [
                    {"kind": "camera_off", "process": "chaser/1", "at_s": 4.5, "duration_s": 1.0}
                ]
            },
            True,
        ),
    ],
)
def test_hand_over_has_a_cause(tmp_path: Path, keys: dict[str, Any], found: bool) -> None:
    """At 5 s: a fault or partition that lasts, or ended in the last 3 s, or a network that loses or
    delays messages.
    """
    log = Log(variant(tmp_path, **keys))
    for tick, term in ((48, 1), (49, 3), (50, 4), (51, 4)):
        log.tick(tick)
        log.flies(0, tick, term)
    assert log.found == ["no hand-over without a cause"] * found


def test_invalid_messages_are_noticed(log: Log) -> None:
    log.checks.observe("chaser/0", RawSample("world/tick", encoding_of(Tick), b"\xc1", 0))
    log.checks.observe("chaser/0", RawSample("nowhere", "", b"", 0))
    assert log.found == ["valid messages"]


WRONG = [
    (msgspec.structs.replace(WRENCH, expires_ns=900_000_000), "a lifetime of 0.1 s, 0.5 stated"),
    (
        msgspec.structs.replace(WRENCH, force_N=(0.0, 2.1, 0.0)),
        "wrench of 1.050 of the body's limits",
    ),
    (msgspec.structs.replace(ACTUATORS, torque_N_m=(0.0, 0.0, -0.06)), "wrench of 1.200"),
    (
        msgspec.structs.replace(
            ACTUATORS, pulses=(ThrusterPulse(thruster=0, open_ns=9, close_ns=19),)
        ),
        "pulse of thruster 0 from 9",
    ),
    (body("target", 0.0, q_wxyz=(1.0, 0.0, 0.0, 0.01)), "quaternion of length 1.00005"),
    (msgspec.structs.replace(BY_TYPE[Sighting], solutions=()), "status seen with 0 solutions"),
    (msgspec.structs.replace(BY_TYPE[TargetEstimate], rejected=(0,)), "both accepted and rejected"),
    (
        msgspec.structs.replace(BY_TYPE[Reference], offset_m=(30.0, 0.0, 0.0)),
        "30.0 m from the target",
    ),
    (
        msgspec.structs.replace(BY_TYPE[Plan], positions_m=()),
        "plan of 1 stages with (0, 8, 6) numbers",
    ),
]


@pytest.mark.parametrize(("message", "text"), WRONG, ids=lambda x: type(x).__name__)
def test_messages_with_impossible_values_are_found(
    message: Any, text: str, scenario: Scenario
) -> None:
    assert text in " ".join(defects_of(message, scenario))


@pytest.mark.parametrize(
    "kind", [WrenchCommand, ActuatorCommand, Sighting, TargetEstimate, Reference]
)
def test_correct_messages_have_no_defects(kind: type, scenario: Scenario) -> None:
    message = {WrenchCommand: WRENCH, ActuatorCommand: ACTUATORS}.get(kind, BY_TYPE.get(kind))
    assert defects_of(message, scenario) == []


def test_covariances_are_symmetric_and_positive_semidefinite() -> None:
    assert covariance_defect(EYE3) == covariance_defect((0.0,) * 9) == ""
    assert "not symmetric" in covariance_defect((1.0, 0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    assert "eigenvalue -1" in covariance_defect((1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0))


def test_pulses_of_a_thruster_do_not_overlap() -> None:
    capture = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    pulses = tuple(ThrusterPulse(thruster=j, open_ns=9 + 5 * j, close_ns=19) for j in (0, 1))
    fired = msgspec.structs.replace(
        ACTUATORS, force_N=(0.0,) * 3, torque_N_m=(0.0,) * 3, pulses=pulses
    )
    assert defects_of(fired, capture) == []
    again = (*pulses, ThrusterPulse(thruster=1, open_ns=18, close_ns=25))
    assert defects_of(msgspec.structs.replace(fired, pulses=again), capture) == [
        "overlapping pulses of thruster 1"
    ]


def ended(log: Log, complete: bool = True) -> Log:
    log.publish(
        topics.END,
        MissionEnd(tick=250, reason="completed" if complete else "no chaser", complete=complete),
    )
    return log


def at_end(log: Log, phase: str) -> None:
    for chaser in (0, 3):
        reference: Any = msgspec.structs.replace(BY_TYPE[Reference], chaser=chaser, phase=phase)
        log.publish(topics.REFERENCE, reference, chaser)


def test_a_complete_mission_lasts_as_long_as_the_scenario(log: Log) -> None:
    log.publish(topics.END, MissionEnd(tick=249, reason="completed", complete=True))
    at_end(log, "docked")
    log.end()
    assert [str(v) for v in log.checks.violations] == [
        "liveness at 0.00 s: world: complete after 249 of 250 ticks"
    ]


@pytest.mark.parametrize(
    ("x_m", "source", "found"),
    [
        (-0.41, "command", []),
        (-0.43, "command", ["liveness"]),
        (-0.43, "hold", []),
        (0.4, "command", ["liveness"]),
    ],
)
def test_a_docked_chaser_is_at_its_docking_place(
    log: Log, x_m: float, source: str, found: list[str]
) -> None:
    """Within 2 cm, unless it falls back."""
    at_end(log, "docked")
    log.bodies(249, body("target", 0.0), body("chaser/0", x_m))
    log.flies(0, 249, source=source)
    ended(log).end()
    assert log.found == found


def test_a_mission_is_docked_or_safe_with_a_reason(log: Log, killed: Scenario) -> None:
    at_end(log, "docked")
    ended(log).end()
    assert log.found == []
    without = Log(killed)
    at_end(without, "hold")
    ended(without).end()
    assert without.found == ["liveness", "liveness"]
    with_reason = Log(killed)
    at_end(with_reason, "hold")
    with_reason.event("no command", "for 2 s", "chaser/0")
    with_reason.event("no command", "for 2 s", "chaser/3")
    ended(with_reason).end()
    assert with_reason.found == []


@pytest.mark.parametrize(
    ("process", "level", "what", "without"),
    [
        (
            "controller",
            "info",
            "chaser 0: hold (from approach: no chaser has seen the target for 3 s)",
            [3],
        ),
        ("controller", "info", "chaser 0: hold (from wait)", [0, 3]),
        ("controller", "warning", "chaser 3: odometry jumped by 2 mm", [0]),
        ("controller", "error", "solver error", []),
        ("world", "warning", "hand-over", []),
        ("chaser/3", "warning", "no command", [0]),
        ("chaser/1", "warning", "no command", [0, 3]),
        ("recorder", "warning", "slow disk", [0, 3]),
    ],
)
def test_a_reason_counts_for_the_chasers_that_it_concerns(
    process: str, level: str, what: str, without: list[int], killed: Scenario
) -> None:
    """A phase that guidance chose names its reason as information."""
    log = Log(killed)
    at_end(log, "hold")
    log.event(what, "", process, level)
    ended(log).end()
    assert [v.text for v in log.checks.violations] == [
        f"chaser/{i}: ends in phase hold without a named reason" for i in without
    ]


@pytest.mark.parametrize(
    ("end_tick", "state", "found"), [(305, "unfinished", []), (307, "", ["liveness"] * 2)]
)
def test_a_mission_has_the_time_of_an_approach_after_a_reason(
    end_tick: int, state: str, found: list[str], killed: Scenario
) -> None:
    """That is 20.6 s in fault-drill."""
    log = Log(killed)
    at_end(log, "approach")
    log.tick(100)
    log.event("process lost", "controller")
    log.tick(end_tick)
    ended(log).end()
    assert log.state(0) == state
    assert log.found == found


@pytest.mark.parametrize(
    ("x_m", "back", "state"), [(-1.0, False, "unfinished"), (-1.3, False, ""), (-1.0, True, "")]
)
def test_a_lost_chaser_in_the_way_keeps_others_from_docking(
    x_m: float, back: bool, state: str, killed: Scenario
) -> None:
    """Seeds 984 and 1296 of `fault-drill`: it drifted within the distance that the others keep from
    it.
    """
    log = Log(killed)
    at_end(log, "approach")
    log.bodies(1, body("target", 0.0), body("chaser/0", -0.8), body("chaser/2", x_m))
    log.event("process lost", "chaser/2")
    log.tick(400, (0, 1, 2, 3) if back else (0, 1, 3))
    assert log.state(0) == state


def test_a_chaser_that_falls_back_is_safe(killed: Scenario) -> None:
    """It states no phase: the last one is that of a controller that is gone."""
    log = Log(killed)
    at_end(log, "approach")
    log.tick(10)
    for chaser, source in ((0, "hold"), (3, "command")):
        log.event("no command", "for 2 s", f"chaser/{chaser}")
        log.tick(400)
        log.flies(chaser, 400, source=source)
    ended(log).end()
    assert [log.state(i) for i in (0, 3)] == ["safe", "unfinished"]
    assert log.checks.outcome == "unfinished"
    at_end(log, "docked")
    assert log.checks.outcome == "safe"
    log.flies(0, 401)
    assert log.checks.outcome == "docked"


def test_a_chaser_that_is_not_commanded_to_approach_may_hold(tmp_path: Path) -> None:
    approach = {"command": "approach", "at_s": 5.0}
    log = Log(
        variant(
            tmp_path,
            timeline=[{**approach, "chasers": [0]}, {**approach, "at_s": 25.0, "chasers": [3]}],
        )
    )
    at_end(log, "hold")
    ended(log).end()
    assert {v.text.partition(":")[0] for v in log.checks.violations} == {"chaser/0"}
    none = Log(variant(tmp_path, timeline=[]))
    at_end(none, "hold")
    ended(none).end()
    assert none.found == []
    assert none.checks.outcome == "safe"


def test_an_undisturbed_mission_docks(log: Log) -> None:
    at_end(log, "hold")
    log.event("no command", "for 2 s", "chaser/0")
    ended(log).end()
    assert [str(v) for v in log.checks.violations] == [
        f"liveness at 0.00 s: chaser/{i}: ends in phase hold, although nothing disturbed it"
        for i in (0, 3)
    ]


def test_crashes_stalls_and_early_ends_are_violations(scenario: Scenario) -> None:
    log = Log(scenario)
    log.end({"controller": "Traceback\nValueError: x"}, ("chaser/0",))
    assert log.found == ["no crash", "liveness", "liveness"]
    assert "ValueError: x" in log.checks.violations[0].text
    early = ended(Log(scenario), complete=False)
    at_end(early, "docked")
    early.end()
    assert early.found == ["liveness"]


def result(**means: float) -> SimulationResult:
    """Return a flight with a mean NEES of a chaser and of the target, and a tracking error."""
    keys = {"chaser": (NEES.name, "chaser/1"), "target": (NEES.name, "target")}
    keys["tracking"] = (TRACKING.name, "chaser/1")
    found = tuple((*keys[name], mean) for name, mean in means.items())
    return SimulationResult(1, {}, (), "docked", "", found, 25.0)


@pytest.mark.parametrize(
    ("means", "number", "text"),
    [
        ({"target": 6.0, "chaser": 6.0, "tracking": 1.0}, 30, ""),
        ({"target": 11.0}, 19, ""),
        ({"target": 11.0}, 30, "covariance consistency: target: mean NEES 11.00 over 30 flights"),
        ({"target": 6.0, "chaser": 1.5}, 30, "covariance consistency: chaser/1: mean NEES 1.50"),
        ({"tracking": 3.0}, 30, "tracking accuracy: chaser/1: mean normalized tracking error 3.00"),
        # The more flights, the closer to the bounds.
        ({"chaser": 9.0}, 30, ""),
        ({"chaser": 9.0}, 100, "mean NEES 9.00 over 100 flights, allowed 3.30 to 8.70"),
    ],
)
def test_each_quantity_has_its_expectation_over_many_flights(
    means: dict[str, float], number: int, text: str
) -> None:
    flights = [result(**means)] * number + [result()] * 30
    found = inaccuracies(flights)
    assert len(found) == bool(text)
    assert text in "".join(found)


def test_means_of_sound_flights_pass_and_few_values_are_not_judged() -> None:
    """Ensembles drawn with the expectation's own spread: 4 standard errors."""
    rng, expected = np.random.default_rng(0), Expectation("check", "size", 6.0, 6.0, 3.0, 28.0)
    for number in (20, 200):
        drawn = rng.gamma(4.0, 1.5, (500, number))
        assert [x for x in drawn.tolist() if expected.defect_over(x)] == []
        assert all(expected.defect_over((x + 7.0).tolist()) for x in drawn)
    assert expected.defect_of([28.1] * 4) is None
    assert expected.defect_of([28.1] * 5) == "mean size 28.1 in one flight, at most 28"


def observe_tracking(log: Log, sigma_m: float, estimate_m: float, control_m: float) -> None:
    """Let chaser 1 hold a place for 15 s around a target that turns, at a distance from where it is
    estimated and from its reference.
    """
    place = np.array([0.3, -1.1, 0.4])
    q_target = codec.vector(rotations.normalize([0.4, -0.5, 0.6, 0.2]))
    at = rotations.rotate(np.array(q_target), place)
    spread = tuple((np.eye(6) * sigma_m**2).ravel().tolist())
    for tick in range(0, 250, 10):
        own = msgspec.structs.replace(
            body("chaser/1", 0.0), position_m=tuple(np.add(at, (2.0, 0.0, 0.0)).tolist())
        )
        log.bodies(tick, body("target", 2.0, q_wxyz=q_target), own)
        head: Any = {"tick": tick, "sim_time_ns": tick * 100_000_000}
        relative = RelativeEstimate(
            chaser=1,
            position_m=tuple(np.add(place, (estimate_m, 0.0, 0.0)).tolist()),
            q_wxyz=tuple(rotations.conjugate(np.array(q_target)).tolist()),
            covariance=spread,
            force_N=(0.0, 0.0, 0.0),
            torque_N_m=(0.0, 0.0, 0.0),
        )
        sample: Any = BY_TYPE[TargetEstimate]
        estimate = msgspec.structs.replace(
            sample, position_m=(2.0, 0.0, 0.0), q_wxyz=q_target, relative=(relative,), **head
        )
        log.publish(topics.TARGET, estimate, sender="controller")
        asked = tuple(np.add(place, (0.0, control_m, 0.0)).tolist())
        reference: Any = msgspec.structs.replace(
            BY_TYPE[Reference], chaser=1, offset_m=asked, **head
        )
        log.publish(topics.REFERENCE, reference, 1, sender="controller")


def test_flight_of_each_chaser_has_its_own_bounds(tmp_path: Path) -> None:
    """Relative NEES and tracking error are those of its pose in the target's turned axes."""
    sigma_m = 1e-3
    nees_m = sigma_m * np.sqrt(FLIGHT_NEES)
    lag_m = FLIGHT_TRACKING * np.sqrt(3 * sigma_m**2 + 1e-6)
    lying = variant(
        tmp_path, fault=[{"kind": "lying_sensor", "process": "chaser/0", "offset_m": [1.0, 0, 0],
                          "at_s": 0.1, "duration_s": 0.1}],
    )  # fmt: skip
    for estimate_m, control_m, expected in (
        (0.98 * nees_m, 0.98 * lag_m, []),
        (1.02 * nees_m, 0.0, ["covariance consistency"]),
        (0.0, 1.02 * lag_m, ["tracking accuracy"]),
    ):
        log, liar = Log(load_scenario(DRILL)), Log(lying)
        for flight in (log, liar):
            observe_tracking(flight, sigma_m, estimate_m, control_m)
            ended(flight).end()
        found = {v.invariant: v.text for v in log.checks.violations}
        accuracy = ("covariance consistency", "tracking accuracy")
        assert [name for name in accuracy if name in found] == expected
        assert all(found[name].startswith("chaser/1") for name in expected)
        assert not set(accuracy) & set(liar.found)


# -- shrinking -------------------------------------------------------------------------------------


def test_shrinking_leaves_what_the_failure_needs(scenario: Scenario) -> None:
    case: Case = draw_case("fault-drill", 2, scenario)
    culprit = {
        "kind": "drop",
        "at_s": 7.34,
        "duration_s": 3.71,
        "process": "chaser/2",
        "topic": "wrench",
        "share": 0.5,
    }
    case["fault"] = [
        *case["fault"],
        {"kind": "freeze", "at_s": 3.0, "duration_s": 1.0, "process": "world"},
        culprit,
    ]
    case["simulation"] |= {
        "partition": [{"at_s": 1.0, "duration_s": 1.0, "processes": ["world"]}],
        "loss": 0.01,
    }
    original = copy.deepcopy(case)
    calls = 0

    def violation_s(c: Case) -> float | None:
        nonlocal calls
        calls += 1
        drops = [f for f in c["fault"] if f["kind"] == "drop" and f["process"] == "chaser/2"]
        long = any(f["duration_s"] >= 0.9 and f["at_s"] < c.get("duration_s", 25.0) for f in drops)
        return (
            drops[-1]["at_s"] + 1.86
            if long and c.get("simulation", {}).get("loss", 0.0) > 0.0
            else None
        )

    *_, small = shrink(case, violation_s, violated_s=9.2, duration_s=25.0)
    assert case == original
    assert violation_s(small) is not None
    assert small["duration_s"] == 2.5
    assert small["simulation"] == {"loss": 0.01}
    assert small["fault"] == [{**culprit, "at_s": 0.1, "duration_s": 1.0, "share": 1.0}]
    assert "truth" not in small
    assert small["seed"] == 0
    assert calls < 120


def test_shrinking_stops_after_its_attempts(scenario: Scenario) -> None:
    calls = 0

    def violation_s(_: Case) -> None:
        nonlocal calls
        calls += 1

    case = draw_case("fault-drill", 5, scenario)
    assert list(shrink(case, violation_s, 3.0, 25.0, attempts=7)) == []
    assert calls <= 7


def test_shrinking_never_lengthens_a_flight() -> None:
    (simpler, *_) = shrink({"extends": "single", "seed": 5}, lambda _: 1.0, 1.0, duration_s=1.0)
    assert simpler == {"extends": "single", "seed": 0}


def test_shrinking_simplifies_errors_of_clocks() -> None:
    jump = {
        "kind": "clock_jump",
        "at_s": 18.37,
        "duration_s": 7.91,
        "process": "controller",
        "offset_s": -73.218,
    }
    clock = {"process": "world", "offset_s": -523.4, "drift": -0.0123}
    case: Case = {"extends": "fault-drill", "fault": [jump], "simulation": {"clock": [clock]}}

    def violation_s(c: Case) -> float | None:
        late = any(f["offset_s"] < -1.0 for f in c.get("fault", ()))
        behind = any(
            k.get("offset_s", 0.0) < -100.0 for k in c.get("simulation", {}).get("clock", ())
        )
        return 20.0 if late and behind else None

    *_, small = shrink(case, violation_s, 20.0, 25.0)
    assert small["fault"] == [
        {
            "kind": "clock_jump",
            "at_s": 0.1,
            "duration_s": 0.1,
            "process": "controller",
            "offset_s": -1.1,
        }
    ]
    assert small["simulation"] == {"clock": [{"process": "world", "offset_s": -131.0}]}


def a_result(case: Case, *violations: Violation) -> SimulationResult:
    return SimulationResult(1, case, violations, "", "", (), 1.0)


def shrunk(result: SimulationResult) -> Case:
    *_, simplest = shrink_result(result)
    return simplest.case


STALL = Violation("liveness", 13.2, "world: has not ended")
NOT_DOCKED = Violation("liveness", 25.0, "chaser/0: ends in phase hold without a named reason")
FLOOD = {
    "kind": "flood",
    "at_s": 5.0,
    "duration_s": 12.0,
    "process": "world",
    "topic": "odometry",
    "copies": 200,
}


def test_shrinking_keeps_the_violation_not_only_its_invariant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A flight that is cut before its chasers can dock violates liveness, too."""

    def flown(case: Case, seed: int) -> SimulationResult:
        wanted = case.get("success", {}).get("docked", [0])
        cut = [NOT_DOCKED] if wanted and case.get("duration_s", 25.0) < 20.0 else []
        return a_result(case, *([STALL] if case["fault"] else cut))

    monkeypatch.setattr("chaserdock.simulation.seeds.fly_case", flown)
    case: Case = {"extends": "fault-drill", "fault": [FLOOD]}
    small = shrunk(a_result(case, STALL))
    assert [fault["kind"] for fault in small["fault"]] == ["flood"]
    assert small["duration_s"] == 14.0
    assert flown({**small, "fault": []}, 1).violations == ()


def test_shrinking_keeps_the_commands_to_approach_of_a_chaser_that_does_not_dock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def flown(case: Case, seed: int) -> SimulationResult:
        commands = [entry["command"] for entry in case["timeline"]]
        docks = "approach" in commands and not case["fault"]
        return a_result(case, *([] if docks else [NOT_DOCKED]))

    monkeypatch.setattr("chaserdock.simulation.seeds.fly_case", flown)
    timeline = [
        {"at_s": 5.0, "command": "approach", "chasers": [0]},
        {"at_s": 9.0, "command": "hold", "chasers": [1]},
    ]
    case: Case = {"extends": "fault-drill", "fault": [FLOOD], "timeline": timeline}
    small = shrunk(a_result(case, NOT_DOCKED))
    assert [entry["command"] for entry in small["timeline"]] == ["approach"]
    assert len(small["fault"]) == 1


def test_shrinking_takes_violations_that_differ_in_numbers_only_as_equal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def flown(case: Case, seed: int) -> SimulationResult:
        chaser = 2 if case["seed"] else 1
        return a_result(
            case, Violation("no contact", 1.0, f"chaser/{chaser}: {len(case['fault'])}e-05 m")
        )

    monkeypatch.setattr("chaserdock.simulation.seeds.fly_case", flown)
    case: Case = {"extends": "fault-drill", "fault": [FLOOD], "seed": 3}
    small = shrunk(flown(case, 1))
    assert (small["fault"], small["seed"]) == ([], 3)


def test_violations_print_as_one_line() -> None:
    assert (
        str(Violation("no contact", 1.25, "a and b: touch"))
        == "no contact at 1.25 s: a and b: touch"
    )
