# SPDX-License-Identifier: Apache-2.0
"""Flight software cannot hold ground truth: what a FlightScenario can contain, and what the flying
packages import.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from chaserdock_protocol.scenario import (
    FlightScenario,
    Scenario,
    ScenarioError,
    flight_scenario,
    flight_scenario_from_json,
    flight_scenario_json,
    load_scenario,
    parse_scenario,
)
from chaserdock_protocol.scenario.bodies import Target
from chaserdock_protocol.scenario.camera import (
    CameraSection,
    EarthSection,
    Eclipse,
    Effects,
)
from chaserdock_protocol.scenario.faults import Fault, ProcessFaults
from chaserdock_protocol.scenario.mission import Chaser, Success
from chaserdock_protocol.scenario.schema import TimelineEntry
from chaserdock_protocol.scenario.thrusters import ThrusterFailure
from chaserdock_protocol.scenario.truth import (
    CameraTruth,
    ChaserTruth,
    SensorTruth,
    TargetTruth,
    TruthSection,
    TruthValues,
)
from chaserdock_protocol.shipped_scenarios import shipped_names, shipped_scenario
from pydantic import BaseModel, Field
from source_tree import MODULES, imported, short, tree_of

FORBIDDEN_TYPES = {
    Scenario, Target, Chaser, CameraSection, Effects, Eclipse, EarthSection, Fault, ProcessFaults,
    ThrusterFailure, Success, TruthSection, ChaserTruth, TargetTruth, CameraTruth, SensorTruth,
    TruthValues,
}  # fmt: skip
FORBIDDEN_ANYWHERE = {
    "lab", "simulation", "world",
    "seed", "truth", "velocity_m_s", "omega_rad_s", "start_offset_m", "start_rotation_rad",
    "start_velocity_m_s",
    "thruster_failure", "fault", "reported_failures", "success", "settling_s", "effects",
    "sun_direction", "ambient", "lamp", "eclipses", "earth", "description",
}  # fmt: skip
GATEWAY_OWNERS = ("check", "lab", "process", "resume")
"""Modules of the gateway that know the scenario's devices and limits."""
FORBIDDEN_PATHS = {"target.position_m", "target.q_wxyz", "target.attitude_deg"}


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models in a type, within tuples, unions and Annotated."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from models_in(inner)


def fields_of(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Path of every field that can be reached, and the model that has it."""
    for name, info in model.model_fields.items():
        yield f"{path}{name}", model
        for inner in models_in(info.annotation):
            yield from fields_of(inner, f"{path}{name}.")


def truth_in(model: type[BaseModel]) -> set[str]:
    """Fields that flight software must not have."""
    return {
        path
        for path, owner in fields_of(model)
        if owner in FORBIDDEN_TYPES
        or path.rpartition(".")[2] in FORBIDDEN_ANYWHERE
        or path in FORBIDDEN_PATHS
        or ("at_s" in path.split(".") and owner is not TimelineEntry)
    }


def test_no_ground_truth_is_reachable_in_a_flight_scenario() -> None:
    assert truth_in(FlightScenario) == set()


def test_the_walk_reaches_nested_fields_and_finds_truth() -> None:
    paths = {path for path, _ in fields_of(FlightScenario)}
    assert {
        "chaser.thrusters.thrust_N",
        "docking.ports.axis",
        "target.geometry.markers.side_m",
    } <= paths
    found = truth_in(Scenario)
    forbidden = FORBIDDEN_PATHS | {
        "seed",
        "camera.effects.gain",
        "fault.kind",
        "chasers.start_offset_m",
        "success",
    }
    assert forbidden <= found

    class Leaky(FlightScenario):
        spare: tuple[dict[str, Effects | None], ...] = Field(default=())

    assert "spare.gain" in truth_in(Leaky)


def test_every_field_that_is_not_shared_is_known_to_be_truth_or_bookkeeping() -> None:
    """A new key of the full scenario is hidden unless it is declared in the flight scenario."""
    only_full = set(Scenario.model_fields) - set(FlightScenario.model_fields)
    assert only_full - {"extends", "steady_until_s", "world", "learning"} <= FORBIDDEN_ANYWHERE


# -- values ----------------------------------------------------------------------------------------

TRUTH = {
    "seed": 77,
    "description": "x",
    "settling_s": 3.0,
    "target": {
        "position_m": [4.0, 5.0, 6.0],
        "q_wxyz": [0.6, 0.8, 0.0, 0.0],
        "velocity_m_s": [0.1, 0.2, 0.3],
        "omega_rad_s": [0.3, 0.2, 0.1],
    },
    "camera": {
        "sun_direction": [1.0, 2.0, 3.0],
        "ambient": 0.2,
        "lamp": 9.0,
        "eclipses": [{"from_s": 1.0, "to_s": 2.0}],
        "earth": {"direction": [0.0, 0.0, -1.0]},
        "effects": {"gain": 2.0, "read_noise": 9.0},
    },
    "fault": [
        {"kind": "drop", "process": "chaser/0", "topic": "image", "at_s": 1.0, "duration_s": 2.0}
    ],
    "success": {"docked": [0], "keep_distances": False},
}
CHASER = {"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
START = {
    "start_offset_m": [0.1, 0.2, 0.3],
    "start_rotation_rad": [0.1, 0.0, 0.2],
    "start_velocity_m_s": [0.1, 0, 0],
}


def scenario(chaser: dict[str, Any], **values: Any) -> Scenario:
    return parse_scenario(
        {"name": "mine", "duration_s": 10.0, "chasers": [chaser], **values}, "test"
    )


def test_flight_scenario_does_not_depend_on_truth() -> None:
    plain, other = scenario(CHASER), scenario({**CHASER, **START}, **TRUTH)
    assert plain != other
    assert flight_scenario_json(plain) == flight_scenario_json(other)
    assert flight_scenario(plain) == flight_scenario(other)


@pytest.mark.parametrize("name", shipped_names())
def test_flight_scenario_keeps_its_values_and_types(name: str) -> None:
    full = load_scenario(shipped_scenario(name))
    flight = flight_scenario(full)
    assert type(flight) is FlightScenario
    (kind, *_) = get_args(type(flight).model_fields["chasers"].annotation)
    assert {type(c) for c in flight.chasers} == {kind}
    assert type(flight.target) is FlightScenario.model_fields["target"].annotation
    assert type(flight.camera) is FlightScenario.model_fields["camera"].annotation
    assert flight.camera_model() == full.camera_model()
    if not full.maps_target:
        assert flight.target_model() == full.target_model()
    assert (flight.timing, flight.chaser, flight.docking) == (
        full.timing,
        full.chaser,
        full.docking,
    )
    assert (
        flight_scenario_from_json(flight_scenario_json(full), "test")
        == flight
        == flight_scenario(flight)
    )


def test_flight_software_that_maps_its_target_knows_nothing_of_it() -> None:
    full = load_scenario(shipped_scenario("unknown-inspection"))
    flight = flight_scenario(full)
    model = flight.target_model()
    assert full.target_model().boxes
    assert (model.boxes, model.markers, model.satellite) == ((), (), "")
    assert flight.target.known_mesh() is flight.target.nominal_mesh() is flight.target.geometry
    text = flight_scenario_json(full)
    assert full.target.model not in text
    # Another satellite, or a mass, changes nothing of what flight software gets.
    changes = {"target": {"model": "cubesat_12u", "mass_kg": 7.0, "centre_of_mass_m": [0.1, 0, 0]}}
    values = {"perception": {"name": "features"}}
    other = scenario(CHASER, **values, **changes)
    assert flight_scenario_json(other) == flight_scenario_json(
        scenario(CHASER, **values, target={"model": "geo_servicer"})
    )


def test_flight_software_that_maps_its_target_refuses_to_know_it() -> None:
    values = json.loads(
        flight_scenario_json(scenario(CHASER, target={"model": "geo_servicer"}, **_BY_SHAPE))
    )
    assert values["target"]["model"] == "geo_servicer"
    values["perception"]["name"] = "features"
    with pytest.raises(ScenarioError, match="may know nothing of it"):
        flight_scenario_from_json(json.dumps(values), "test")
    values["target"] = {"motion": "constant_rates", "model": "unknown"}
    assert flight_scenario_from_json(json.dumps(values), "test").maps_target


_BY_SHAPE = {"perception": {"name": "model"}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": {"motion": "torque_free"}}, "maps constant rates only"),
        ({"limits": {"min_distance_shape_m": 0.1}}, "the shape of the target is unknown"),
        ({"target": {"model": "unknown"}}, "the world needs a shape"),
        ({"docking": {"kind": "capture"}}, "docking"),
        ({"mapping": {"latency_s": 0.4}, "time": {"rate_hz": 2, "image_hz": 2}}, "interval of"),
    ],
)
def test_missions_that_need_a_known_shape_are_refused(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario(CHASER, perception={"name": "features"}, **changes)


_PORT = {"at_s": 9.0, "command": "port", "chasers": [0], "port": {"find": "flat"}}


@pytest.mark.parametrize(
    ("timeline", "changes", "message"),
    [
        ([_PORT | {"port": {}}], {}, "needs either image and pixel, or point_m, or find"),
        ([_PORT | {"port": {"pixel": [1, 2]}}], {}, "needs either image and pixel"),
        ([_PORT | {"port": {"find": "flat", "point_m": [1, 0, 0]}}], {}, "needs either"),
        (
            [_PORT | {"port": {"find": "flat", "radii_m": [0.1, 0.2]}}],
            {},
            "for a ring only",
        ),
        (
            [_PORT | {"port": {"find": "ring", "radii_m": [0.2, 0.1]}}],
            {},
            "for a ring only",
        ),
        ([_PORT | {"port": {"find": "ring", "radii_m": [0.1, 0.2]}}], {}, ""),
        ([{"at_s": 9.0, "command": "port", "chasers": [0]}], {}, "port goes with the command port"),
        ([{"at_s": 8.0, "command": "goto", "chasers": [0]}, _PORT], {}, "timeline.0: offset_m"),
        ([_PORT], {"perception": {"name": "default"}}, "timeline.0: ports are chosen on unknown"),
        ([_PORT], {"approach": {"dock_distance_m": 0.3}}, "not more than chaser.probe_reach_m"),
        ([_PORT | {"chasers": [7]}], {}, "there is no chaser 7"),
        ([_PORT, {"at_s": 9.0, "command": "goto", "chasers": [0]}], {}, ""),
    ],
)
def test_a_port_in_the_timeline_is_checked(
    timeline: list[dict[str, Any]], changes: dict[str, Any], message: str
) -> None:
    unknown = {"perception": {"name": "features"}, "approach": {"dock_distance_m": 0.5}}
    case = unknown | changes | {"timeline": timeline}
    if message:
        with pytest.raises(ScenarioError, match=message):
            scenario(CHASER, **case)
        return
    flown = scenario(CHASER, **case)
    assert flown.chooses_port(0)
    assert not flown.chooses_port(1)
    assert flight_scenario_from_json(flight_scenario_json(flown), "test").chooses_port(0)


def test_flight_software_refuses_a_full_scenario() -> None:
    with pytest.raises(ScenarioError, match=r"unknown key seed"):
        flight_scenario_from_json(scenario(CHASER).model_dump_json(), "test")


def test_error_in_a_flight_scenario_names_the_path() -> None:
    values = json.loads(flight_scenario_json(scenario(CHASER)))
    values["limits"]["min_distance_target_m"] = 5.0
    with pytest.raises(
        ScenarioError, match=r"test: .*chasers.0.position_m: 1 m from the target, nearer"
    ):
        flight_scenario_from_json(json.dumps(values), "test")


# -- imports ---------------------------------------------------------------------------------------

FULL_SCENARIO = {
    "Scenario", "load_scenario", "parse_scenario", "scenario_from_json", "mission", "loading",
    "Target", "Chaser",
    "CameraSection", "faults_of", "request_scenario", "SCENARIO_KEY",
}  # fmt: skip
FLYING_PACKAGES = [
    path for package, path in MODULES if package in ("chaserdock_agents", "chaserdock_controller")
]
RECORDER = Path("recorder/process.py")


def uses_of_full_scenario(path: Path) -> set[str]:
    """Names by which a module reaches the full scenario."""
    of_protocol = {name for name in imported(path) if name.startswith("chaserdock_protocol.")}
    used = {node.attr for node in ast.walk(tree_of(path)) if isinstance(node, ast.Attribute)}
    return ({name.rpartition(".")[2] for name in of_protocol} | used) & FULL_SCENARIO


@pytest.mark.slow
def test_flying_packages_do_not_load_the_full_scenario() -> None:
    """The recorder asks for it, and stores it in the log as text; a gateway takes the place of the
    world, and knows no truth.
    """
    found = {short(p): names for p in FLYING_PACKAGES if (names := uses_of_full_scenario(p))}
    gateway = {k for k in found if k.startswith("agents/chaserdock_agents/gateway/")}
    assert gateway == {f"agents/chaserdock_agents/gateway/{n}.py" for n in GATEWAY_OWNERS}
    found = {k: names for k, names in found.items() if k not in gateway}
    assert found == {f"agents/chaserdock_agents/{RECORDER}": {"request_scenario"}}
