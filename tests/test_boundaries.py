"""The architecture, held: who imports what, and that nothing that flies can see the truth."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.topics import Role
from chaserdock_protocol.transport import Link, Node

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "chaserdock_protocol": ROOT / "protocol" / "chaserdock_protocol",
    "chaserdock_world": ROOT / "world" / "chaserdock_world",
    "chaserdock_agents": ROOT / "agents" / "chaserdock_agents",
    "chaserdock_controller": ROOT / "controller" / "chaserdock_controller",
}
MODULES = [(package, path) for package, folder in PACKAGES.items() for path in sorted(folder.rglob("*.py"))]
FLYING = [p for _, p in MODULES if p.is_relative_to(PACKAGES["chaserdock_controller"])] + [
    p for _, p in MODULES if p.is_relative_to(PACKAGES["chaserdock_agents"] / "chaser")
]
PERCEPTION = [p for _, p in MODULES if p.is_relative_to(PACKAGES["chaserdock_agents"] / "perception")]


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a module imports, wherever in it; relative ones as they are meant."""
    package = next(f for f in PACKAGES.values() if path.is_relative_to(f))
    parts = (package.name, *path.relative_to(package).parts[:-1])
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = parts[: len(parts) - node.level + 1] if node.level else ()
            yield ".".join((*base, *(node.module or "").split("."))).strip(".")
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            # importlib.import_module("..."), __import__("...")
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            if name in ("import_module", "__import__") and node.args:
                assert isinstance(node.args[0], ast.Constant), f"{path}: import of a computed name"
                yield str(node.args[0].value)


def short(item: object) -> str:
    return str(item.relative_to(ROOT)) if isinstance(item, Path) else str(item)


def test_there_are_modules_to_check() -> None:
    assert all(folder.is_dir() for folder in PACKAGES.values())
    assert len(MODULES) > 40
    assert len(FLYING) > 15
    assert len(PERCEPTION) >= 5


def test_relative_imports_are_resolved() -> None:
    """The checks below are only as good as this."""
    guidance = PACKAGES["chaserdock_controller"] / "guidance.py"
    assert "chaserdock_controller.moves" in set(imported(guidance))
    assert "chaserdock_protocol.scenario" in set(imported(guidance))
    eye = PACKAGES["chaserdock_agents"] / "chaser" / "process.py"
    assert "chaserdock_agents.chaser.pilot" in set(imported(eye))


@pytest.mark.parametrize(("package", "path"), MODULES, ids=short)
def test_packages_import_the_protocol_and_never_each_other(package: str, path: Path) -> None:
    allowed = {package, "chaserdock_protocol"}
    ours = {name for name in imported(path) if name.partition(".")[0].startswith("chaserdock")}
    assert {name for name in ours if name.partition(".")[0] not in allowed} == set()


@pytest.mark.parametrize(("library", "homes"), [("zenoh", ["transport.py"]), ("pybullet", ["bullet.py"])])
def test_few_modules_know_the_library(library: str, homes: list[str]) -> None:
    users = [p.name for _, p in MODULES if any(n.split(".")[0].startswith(library) for n in imported(p))]
    assert users == homes


@pytest.mark.parametrize("path", [p for _, p in MODULES], ids=short)
def test_no_module_is_longer_than_400_lines(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


# -- the truth --------------------------------------------------------------------------------------------

TRUTHS = {name for name in vars(topics) if name.startswith("TRUTH")}


@pytest.mark.parametrize("path", [*FLYING, *PERCEPTION], ids=short)
def test_what_flies_does_not_even_mention_the_truth(path: Path) -> None:
    for node in ast.walk(tree_of(path)):
        named = (
            node.attr
            if isinstance(node, ast.Attribute)
            else node.id
            if isinstance(node, ast.Name)
            else node.name
            if isinstance(node, ast.alias)
            else ""
        )
        assert not named.startswith("TRUTH"), f"line {getattr(node, 'lineno', '?')}"
        assert named not in ("BodyTruth", "WorldTruth", "subscribe_raw", "TOPICS", "zenoh")
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            assert "truth/" not in node.value
            assert not node.value.startswith("truth")


def test_flying_modules_import_neither_world_nor_log() -> None:
    for path in [*FLYING, *PERCEPTION]:
        names = set(imported(path))
        assert not any(n.startswith(("chaserdock_world", "chaserdock_protocol.log")) for n in names), path


@pytest.fixture(scope="module", params=["chaser", "controller"])
def node(request: pytest.FixtureRequest) -> Iterator[Node]:
    role: Role = request.param
    name = "chaser/0" if role == "chaser" else role
    opened = Node(name, role, Link(namespace="test-boundaries"))
    yield opened
    opened.close()


def test_there_is_a_truth_to_keep_away_from() -> None:
    assert {"TRUTH_BODY", "TRUTH_WORLD"} == TRUTHS


@pytest.mark.parametrize("name", sorted(TRUTHS))
def test_what_flies_cannot_subscribe_the_truth(node: Node, name: str) -> None:
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
def test_what_flies_cannot_subscribe_expressions(node: Node, expression: str) -> None:
    heard: list[object] = []
    with pytest.raises(PermissionError, match="may not read"):
        node.subscribe_raw(expression, heard.append)
    assert heard == []


def test_what_flies_can_subscribe_what_is_meant_for_it(node: Node) -> None:
    node.subscribe(topics.TICK)
    node.subscribe(topics.ODOMETRY, 0)
    with pytest.raises(PermissionError):
        node.subscribe(topics.SOLVER)
    with pytest.raises(PermissionError):
        node.advertise(topics.TICK)
