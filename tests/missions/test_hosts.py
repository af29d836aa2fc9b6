# SPDX-License-Identifier: Apache-2.0
"""A mission on four hosts (network namespaces joined by a bridge), with the shipped configuration
files.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from chaserdock_protocol.process import SINGLE_THREADED
from harness import ROOT, SHORT, sets

HOSTS = {"hub": "10.77.0.1", "ground": "10.77.0.2", "sat-a": "10.77.0.3", "sat-b": "10.77.0.4"}


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def hosts() -> Iterator[dict[str, str]]:
    """Create network namespaces joined by a bridge; yield their names by host."""
    mark = uuid.uuid4().hex[:6]
    names = {host: f"cd-{mark}-{host}" for host in (*HOSTS, "switch")}
    try:
        ip("netns", "add", names["switch"])
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("network namespaces need iproute2 and root")
    made = ["switch"]
    try:
        inside = ("-n", names["switch"])
        ip(*inside, "link", "add", "name", "switch", "type", "bridge")
        ip(*inside, "link", "set", "switch", "up")
        for k, (host, address) in enumerate(HOSTS.items()):
            ip("netns", "add", names[host])
            made.append(host)
            port = ("port", "type", "veth", "peer", "name", f"p{k}", "netns", names["switch"])
            ip("-n", names[host], "link", "add", "name", *port)
            ip("-n", names[host], "address", "add", f"{address}/24", "dev", "port")
            ip("-n", names[host], "link", "set", "port", "up")
            ip("-n", names[host], "link", "set", "lo", "up")
            ip(*inside, "link", "set", f"p{k}", "master", "switch")
            ip(*inside, "link", "set", f"p{k}", "up")
        yield names
    finally:
        for host in made:
            ip("netns", "delete", names[host])


@pytest.mark.slow
def test_mission_over_four_hosts_with_shipped_configuration(
    hosts: dict[str, str], tmp_path: Path
) -> None:
    """Router, world with controller, and each chaser run on separate hosts; only the router
    listens.
    """
    file = tmp_path / "host.json5"
    shipped = (ROOT / "config" / "host.json5").read_text()
    file.write_text(shipped.replace("tcp/router:7447", f"tcp/{HOSTS['hub']}:7447"))
    runs = tmp_path / "runs"
    members = {
        "router": (
            "hub",
            ["router", "--until", "operator", "-c", str(ROOT / "config" / "router.json5")],
        ),
        "world": ("ground", ["world", "two-chaser-tracking", *sets(*SHORT), "-c", str(file)]),
        "controller": ("ground", ["controller", "-c", str(file)]),
        "chaser/0": ("sat-a", ["chaser", "0", "-c", str(file)]),
        "chaser/1": ("sat-b", ["chaser", "1", "-c", str(file)]),
        "recorder": ("hub", ["record", "--out", str(runs), "--by-run", "-c", str(file)]),
        "judge": ("hub", ["judge", str(runs), "--live", "-c", str(file)]),
    }
    processes: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, (host, arguments) in members.items():
            command = [
                "ip",
                "netns",
                "exec",
                hosts[host],
                sys.executable,
                "-m",
                "chaserdock",
                *arguments,
            ]
            processes[name] = subprocess.Popen(
                command,
                env={**os.environ, **SINGLE_THREADED},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
        deadline = time.monotonic() + 300
        outputs = {
            n: p.communicate(timeout=deadline - time.monotonic())[0] for n, p in processes.items()
        }
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()
    assert {p.returncode for p in processes.values()} == {0}, outputs
    (path,) = runs.glob("two-chaser-tracking-*/summary.json")
    summary = json.loads(path.read_text())
    assert summary["success"]
    assert sum(t["lost"] for t in summary["messages"].values()) == 0
