# SPDX-License-Identifier: Apache-2.0
"""Every shipped scenario, shortened: simulated flights equal those of separate processes over Zenoh in lock-step."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from dataclasses import replace
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from chaserdock_protocol.process import SINGLE_THREADED, ProcessOptions
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.transport import Link
from harness import ROOT, simulated_digest

from chaserdock.analysis.flight import load_flight
from chaserdock.launch.launcher import free_port
from chaserdock.toml_text import toml_value

MODULES = {
    "world": "chaserdock_world.process",
    "controller": "chaserdock_controller.process",
    "chaser": "chaserdock_agents.chaser.process",
    "recorder": "chaserdock_agents.recorder.process",
}
SAMPLE = ("docking-contact",)
"""Flown in every test run."""
ELSEWHERE = ("fault-drill", "two-chaser-tracking")
"""Compared in ``test_simulation.py``, with the flights that other tests share."""
SCENARIOS = sorted(path.stem for path in (ROOT / "scenarios").glob("*.toml") if path.stem not in ELSEWHERE)


def run_process(kind: str, options: ProcessOptions) -> None:
    """Run one process of a mission and exit with its status."""
    sys.exit(importlib.import_module(MODULES[kind]).main(options))


@pytest.fixture(scope="module")
def processes() -> ForkServerContext:
    """Return a source of separate processes that have imported their modules already, which takes longest."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(MODULES.values()))
    before = dict(os.environ)
    os.environ.update(SINGLE_THREADED)
    try:
        context.Process(target=int).start()  # the server keeps the environment of its start
    finally:
        os.environ.clear()
        os.environ.update(before)
    return context


def flown_digest(path: Path, out: Path, overrides: tuple[str, ...], processes: ForkServerContext) -> str:
    """Fly a scenario in separate processes over Zenoh; return the digest of the log."""
    endpoint, namespace = f"tcp/127.0.0.1:{free_port()}", f"shipped-{path.stem}"
    common = ProcessOptions(link=Link(namespace, (endpoint,)), out=out, viewer_layer=False, patience_s=60.0)
    world = replace(common, link=Link(namespace, (), (endpoint,)), scenario=path, overrides=overrides)
    starts = [("world", world), ("controller", common), ("recorder", common)]
    starts += [("chaser", replace(common, chaser=i)) for i in range(len(load_scenario(path).chasers))]
    running: list[BaseProcess] = [
        processes.Process(target=run_process, args=start, daemon=True) for start in starts
    ]
    try:
        for process in running:
            process.start()
        for process in running:
            process.join(180.0)
        assert [process.exitcode for process in running] == [0] * len(running)
    finally:
        for process in running:
            process.kill()
    return load_flight(out / "mission.mcap").digest


def shortened(path: Path) -> tuple[str, ...]:
    """Return overrides that compress a scenario's events into a few ticks, with small images."""
    scenario = load_scenario(path)
    duration_s = min(24, max(6, 64 // len(scenario.chasers))) / scenario.time.rate_hz
    share = duration_s / scenario.duration_s
    overrides = [f"duration_s={duration_s}", f"settling_s={0.5 * duration_s}"]
    if scenario.camera.intrinsics is None:
        overrides += ["camera.width_px=320", "camera.height_px=180"]
    for key, events in (("timeline", scenario.timeline), ("thruster_failure", scenario.thruster_failure)):
        moved = [e.model_dump(exclude_none=True) | {"at_s": share * e.at_s} for e in events]
        overrides += [f"{key}={toml_value(moved)}"] if moved else []
    return tuple(overrides)


@pytest.mark.parametrize(
    "name", [n if n in SAMPLE else pytest.param(n, marks=pytest.mark.slow) for n in SCENARIOS]
)
def test_simulated_digest_equals_that_over_zenoh(
    name: str, processes: ForkServerContext, tmp_path: Path
) -> None:
    path = ROOT / "scenarios" / f"{name}.toml"
    overrides = shortened(path)
    assert load_scenario(path, overrides).ticks >= 6
    simulated = simulated_digest(name, tmp_path / "simulated", *overrides)
    assert simulated == flown_digest(path, tmp_path / "flown", overrides, processes)
