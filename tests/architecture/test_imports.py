# SPDX-License-Identifier: Apache-2.0
"""Architecture rules: which packages import which, and that flight software cannot reach ground
truth.
"""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.topics import Role
from chaserdock_protocol.transport import Link, Node
from source_tree import (
    FLYING,
    MODULES,
    PACKAGES,
    imported,
    module_name,
    short,
    tree_of,
)

MAY_IMPORT = {
    "chaserdock_models": set(),
    "chaserdock_protocol": {"chaserdock_models"},
    "chaserdock_world": {"chaserdock_models", "chaserdock_protocol"},
    "chaserdock_agents": {"chaserdock_models", "chaserdock_protocol"},
    "chaserdock_controller": {"chaserdock_models", "chaserdock_protocol"},
    "chaserdock": {
        "chaserdock_models", "chaserdock_protocol", "chaserdock_world", "chaserdock_agents",
        "chaserdock_controller",
    },
}  # fmt: skip
NAMES = {module_name(path): path for _, path in MODULES}


def own_imports(path: Path) -> set[str]:
    """Modules of ours that a module imports."""
    return {name for name in imported(path) if name in NAMES} - {module_name(path)}


def test_there_are_modules_to_check() -> None:
    assert all(folder.is_dir() for folder in PACKAGES.values())
    assert len(MODULES) > 200
    assert len(FLYING) > 60


def test_relative_imports_are_resolved() -> None:
    """The checks below depend on it."""
    chaser = own_imports(PACKAGES["chaserdock_agents"] / "chaser" / "core.py")
    assert {"chaserdock_agents.chaser.command_gate", "chaserdock_protocol.scenario"} <= chaser


def test_imports_point_downwards() -> None:
    upwards = [
        f"{short(path)} imports {name}"
        for package, path in MODULES
        for name in imported(path)
        if name.startswith("chaserdock")
        and name.partition(".")[0] not in {package, *MAY_IMPORT[package]}
    ]
    assert upwards == []


def test_there_are_no_import_cycles() -> None:
    graph: dict[str, set[str]] = {}
    for name, path in NAMES.items():
        # `from package import module` runs the package's __init__ too, but needs only the module.
        found = own_imports(path)
        graph[name] = {f for f in found if not any(other.startswith(f"{f}.") for other in found)}
        if path.name == "__init__.py":
            continue
        graph[name] -= {name.rpartition(".")[0]}
    tuple(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize(
    ("library", "homes"),
    [
        ("zenoh", {"chaserdock_protocol.transport.zenoh_network"}),
        ("pybullet", {"chaserdock_world.physics.bullet"}),
        ("mujoco", {"chaserdock_world.physics.mujoco_engine"}),
    ],
)
def test_one_module_imports_the_library(library: str, homes: set[str]) -> None:
    users = {
        module_name(p)
        for _, p in MODULES
        if any(n.split(".")[0].startswith(library) for n in imported(p))
    }
    assert users == homes


OPTIONAL = {
    "chaserdock.calibration": {"chaserdock.cli.calibrate"},
    "chaserdock.datasets": {"chaserdock.cli.datasets"},
    "chaserdock.envs": set(),
    "chaserdock.experiments": {"chaserdock.cli.compare", "chaserdock.cli.run"},
    "chaserdock.targets": {"chaserdock.cli.target"},
    "chaserdock.tracking": {"chaserdock", "chaserdock.cli.track"},
    "chaserdock_agents.gateway.cameras": {
        "chaserdock.cli.track",
        "chaserdock.tracking.pose_files",
        "chaserdock.tracking.run",
    },
    "chaserdock_agents.ros2": {
        "chaserdock.logs.rosbag",
        "chaserdock_agents.gateway.cameras.image_messages",
        "chaserdock_agents.gateway.drivers.px4_robot",
        "chaserdock_agents.gateway.drivers.ros2_network",
        "chaserdock_agents.gateway.drivers.ros2_robot",
    },
    "chaserdock_agents.gateway.drivers": set(),
    "chaserdock.logs.rosbag": {"chaserdock.cli.logs"},
    "chaserdock_world.physics.mujoco_engine": {"chaserdock_world.physics.engine_factory"},
}
"""What few users need, and the modules that may import it: its command or its table. The process
``ros2`` and drivers are loaded by their entry points.
"""


def belongs(name: str, package: str) -> bool:
    """Return whether a module is a package or inside it."""
    return name == package or name.startswith(f"{package}.")


def test_core_does_not_import_optional_parts() -> None:
    for package, homes in OPTIONAL.items():
        users = {
            name
            for name, path in NAMES.items()
            if not belongs(name, package) and any(belongs(n, package) for n in imported(path))
        }
        assert users == homes, package


def test_optional_parts_are_imported_only_when_they_are_used() -> None:
    for package, homes in OPTIONAL.items():
        for home in homes:
            if any(belongs(home, other) for other in OPTIONAL):
                continue
            at_once = set(imported(NAMES[home], at_once=True))
            assert not any(belongs(name, package) for name in at_once), (package, home)


def test_transport_depends_on_neither_faults_nor_scenario() -> None:
    """Directly or through other modules of the protocol: both are passed in."""
    start = {name for name in NAMES if name.startswith("chaserdock_protocol.transport")}
    reached, waiting = set(start), list(start)
    while waiting:
        for name in own_imports(NAMES[waiting.pop()]) - reached:
            reached.add(name)
            waiting.append(name)
    forbidden = ("chaserdock_protocol.fault_injection", "chaserdock_protocol.scenario")
    assert [name for name in sorted(reached) if name.startswith(forbidden)] == []
    assert "chaserdock_protocol.topics" in reached


# -- the truth -------------------------------------------------------------------------------------

TRUTHS = {name for name in vars(topics) if name.startswith("TRUTH")}


def mentions_of_truth(tree: ast.Module) -> list[int]:
    """Lines that name a topic or message of ground truth, or a way around the table of rights."""
    lines = []
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(attr=name) | ast.Name(id=name) | ast.alias(name=name):
                around = ("BodyTruth", "WorldTruth", "subscribe_raw", "TOPICS", "zenoh")
                found = name.startswith("TRUTH") or name in around
            case ast.Constant(value=str() as text):
                found = "truth/" in text or text.startswith("truth")
            case _:
                found = False
        if found:
            lines.append(getattr(node, "lineno", 0))
    return lines


def test_flight_software_does_not_mention_the_truth() -> None:
    found = {short(p): lines for p in FLYING if (lines := mentions_of_truth(tree_of(p)))}
    assert found == {}


@pytest.mark.parametrize(
    "line", ["topics.TRUTH_BODY", "from x import BodyTruth", "key = 'truth/body'", "import zenoh"]
)
def test_the_check_above_sees_the_truth(line: str) -> None:
    assert mentions_of_truth(ast.parse(line)) == [1]


def test_flying_modules_import_neither_world_nor_log() -> None:
    for path in FLYING:
        names = imported(path)
        assert not any(
            n.startswith(("chaserdock_world", "chaserdock_protocol.recording.log")) for n in names
        ), path


@pytest.fixture(scope="module", params=["chaser", "controller"])
def node(request: pytest.FixtureRequest) -> Iterator[Node]:
    role: Role = request.param
    name = "chaser/0" if role == "chaser" else role
    opened = Node(name, role, Link(namespace="test-boundaries"))
    yield opened
    opened.close()


def test_there_is_a_truth_to_keep_away_from() -> None:
    assert {"TRUTH_BODY", "TRUTH_WORLD", "TRUTH_LOAD", "TRUTH_PLUME", "TRUTH_DRAWN"} == TRUTHS


@pytest.mark.parametrize("name", sorted(TRUTHS))
def test_flight_software_cannot_subscribe_the_truth(node: Node, name: str) -> None:
    topic = getattr(topics, name)
    with pytest.raises(PermissionError, match=f"{node.role} may not read truth/"):
        node.subscribe(topic)
    with pytest.raises(PermissionError):
        node.subscribe(topic, latest=True)
    if "{" in topic.key:
        with pytest.raises(PermissionError):
            node.subscribe(topic, "target")
    with pytest.raises(PermissionError, match="may not write"):
        node.advertise(topic, "target" if "{" in topic.key else None)


@pytest.mark.parametrize("expression", ["**", "truth/**", "world/tick", "*/body/target"])
def test_flight_software_cannot_subscribe_expressions(node: Node, expression: str) -> None:
    heard: list[object] = []
    with pytest.raises(PermissionError, match="may not read"):
        node.subscribe_raw(expression, heard.append)
    assert heard == []


def test_flight_software_can_subscribe_its_inputs(node: Node) -> None:
    node.subscribe(topics.TICK)
    node.subscribe(topics.ODOMETRY, 0)
    with pytest.raises(PermissionError):
        node.subscribe(topics.SOLVER)
    with pytest.raises(PermissionError):
        node.advertise(topics.TICK)


@pytest.mark.slow
def test_processes_start_without_packages_that_only_some_flights_need() -> None:
    """Each import here is one of every process of every flight: SciPy alone was 40 % of the start
    of the world.
    """
    processes = (
        "world.process",
        "agents.chaser.process",
        "agents.recorder.process",
        "controller.process",
    )
    slow = (
        "scipy",
        "casadi",
        "matplotlib",
        "pyarrow",
        "pandas",
        "trimesh",
        "av",
        "viser",
        "cryptography",
    )
    program = (
        f"import sys, {', '.join(f'chaserdock_{p}' for p in processes)}, "
        "chaserdock.launch.launcher\n"
    )
    program += f"print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
