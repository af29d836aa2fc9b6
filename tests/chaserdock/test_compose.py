# SPDX-License-Identifier: Apache-2.0
"""Compose builds the image and flies a short mission if a Docker engine runs; static checks of
compose.yaml and Dockerfile.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from chaserdock_protocol.scenario.fields import MAX_CHASERS
from chaserdock_protocol.transport.access_control import identities
from compose_project import Project, compose_command, docker
from harness import ROOT, SHORT
from ruamel.yaml import YAML

from chaserdock.launch import container
from chaserdock.launch.compose_file import compose_file, default_scenario


def why_no_docker() -> str:
    """Return why no mission can fly in containers on this machine; empty if one can."""
    if shutil.which("docker") is None:
        return "no docker program"
    if subprocess.run(["docker", "info"], capture_output=True, check=False).returncode != 0:
        return "no Docker engine answers"
    try:
        compose_command()
    except SystemExit as reason:
        return str(reason)
    commands = ("image inspect", "pull")
    if all(
        subprocess.run(
            ["docker", *command.split(), "python:3.11-slim"], capture_output=True, check=False
        ).returncode
        for command in commands
    ):
        return "the image python:3.11-slim cannot be pulled"
    return ""


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the working tree without ignored files."""
    if reason := why_no_docker():
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("clone")
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.split(b"\0")
    for name in filter(None, map(os.fsdecode, names)):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


@pytest.mark.slow(minutes=60)  # its building and flying is not this worker's: it starts first
@pytest.mark.timeout(2400)
def test_short_mission_by_compose(clone: Path) -> None:
    """Mission succeeds with access control; exit status, file owners, absence of keys in the image
    and its size.
    """
    owner = (clone / "compose.yaml").stat()
    project = Project("two-chaser-tracking", " ".join(SHORT), clone)
    try:
        built = project.compose("build", "router")
        assert built.returncode == 0, (built.stdout + built.stderr)[-3000:]
        flown = project.compose("up", "--no-build", "--exit-code-from", "mission", timeout_s=900.0)
        said = flown.stdout + flown.stderr
        kept = docker(
            "run", "--rm", "--entrypoint", "find", "chaserdock", "/keys", "-type", "f"
        ).stdout
    finally:
        project.down()
    assert flown.returncode == 0, said[-5000:]
    assert "with access rules" in said
    assert "PRIVATE KEY" not in said
    assert kept == ""
    (log,) = clone.glob("runs/two-chaser-tracking-*/mission.mcap")
    summary = json.loads((log.parent / "summary.json").read_text())
    assert summary["success"]
    assert summary["sim_time_s"] == 6.0
    assert "</html>" in (log.parent / "report.html").read_text()
    for path in (log, log.parent, log.parent / "summary.json", log.parent / "report.html"):
        assert (path.stat().st_uid, path.stat().st_gid) == (owner.st_uid, owner.st_gid)
    inspected = subprocess.run(
        ["docker", "image", "inspect", "chaserdock"], capture_output=True, check=True, text=True
    )
    (image,) = json.loads(inspected.stdout)
    assert image["Size"] < 1.5e9
    assert image["Config"]["User"] not in ("", "root", "0")


def test_container_mounts_only_its_own_keys() -> None:
    """Every service mounts one volume of keys, read-only; only the router, which creates them,
    mounts all.
    """
    service, mounts = "", {}
    for line in (ROOT / "compose.yaml").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"  ([a-z0-9-]+):", line):
            service = found[1]
        for name, where in re.findall(r"keys-([a-z0-9-]+):(/keys[a-z0-9/:-]*)", line):
            mounts.setdefault(service, []).append((name, where))
    everyone = {"router", *(who.common_name for who in identities(4))}
    assert {name for name, _ in mounts.pop("router")} == everyone
    assert set(mounts) == everyone - {"router", "analysis", "bridge"} | {"mission"}
    for service, mounted in mounts.items():
        owner = "operator" if service == "mission" else service
        assert mounted == [(owner, "/keys:ro")], service


def test_file_in_the_repository_is_the_output_for_four_chasers() -> None:
    """Remedy: chaserdock deploy --chasers 4 --standby --view > compose.yaml"""
    assert (ROOT / "compose.yaml").read_text(encoding="utf-8") == compose_file(
        4, standby=True, view=True
    )


@pytest.mark.parametrize("chasers", [*range(1, 17), MAX_CHASERS])
@pytest.mark.parametrize("more", [False, True])
def test_generated_file_has_the_services_and_volumes_of_the_mission(
    chasers: int, more: bool
) -> None:
    project = YAML(typ="safe").load(compose_file(chasers, standby=more, view=more))
    members = {"router", "world", "controller", "mapper", "recorder", "mission", "operator"}
    members |= {"standby", "viewer"} if more else set()
    assert set(project["services"]) == members | {f"chaser-{i}" for i in range(chasers)}
    mounted = {
        volume.partition(":")[0]
        for service in project["services"].values()
        for volume in service["volumes"]
        if not volume.startswith(".")
    }
    assert set(project["volumes"]) == mounted
    services = int(project["services"]["world"]["environment"]["CHASERS"])
    assert services == chasers
    assert container.too_many_chasers(default_scenario(chasers), "", services) is None
    assert f"--chasers {chasers}" in project["services"]["router"]["command"][0]


@pytest.mark.parametrize("chasers", [0, MAX_CHASERS + 1])
def test_number_of_chasers_is_limited_by_the_image(chasers: int) -> None:
    with pytest.raises(ValueError, match=f"must be from 1 to {MAX_CHASERS}"):
        compose_file(chasers)


def test_build_context_contains_what_the_image_copies() -> None:
    """Every source of a COPY instruction, or its top folder, is an exception in .dockerignore,
    which excludes everything else.
    """
    instructions = re.findall(
        r"^COPY (?!--from)(.+) \S+$", (ROOT / "Dockerfile").read_text(), re.MULTILINE
    )
    copied = {source for line in instructions for source in line.split()}
    context = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line.startswith("!")
    }
    sources = {source if source in context else source.partition("/")[0] for source in copied}
    assert {"chaserdock", "docker", "pyproject.toml"} <= sources
    assert sources == context


def test_image_has_a_key_folder_per_process() -> None:
    """A volume inherits the mode of the folder at its mount point; without that folder only root
    could write.
    """
    found = re.search(
        r"for name in ([a-z \\\n]+) \$\(seq -f chaser-%g 0 (\d+)\); do mkdir /keys",
        (ROOT / "Dockerfile").read_text(),
    )
    assert found
    names, chasers = set(found[1].replace("\\", " ").split()), int(found[2]) + 1
    assert chasers == MAX_CHASERS
    assert names | {f"chaser-{i}" for i in range(chasers)} == {
        "router",
        *(who.common_name for who in identities(chasers)),
    }


def test_only_the_viewer_is_published_and_on_loopback_only() -> None:
    text = (ROOT / "compose.yaml").read_text(encoding="utf-8")
    assert not re.search(r"^\s*(network_mode|privileged|container_name)\s*:", text, re.MULTILINE)
    published = re.findall(r"^\s*ports\s*:.*$", text, re.MULTILINE)
    assert [line.strip() for line in published] == ['ports: ["127.0.0.1:${VIEW_PORT:-8080}:8080"]']
    viewer = text[text.index("\n  viewer:") :]
    assert published[0] in viewer[: viewer.index("\n\n")]
    assert "profiles: [view]" in viewer[: viewer.index("\n\n")]
