# SPDX-License-Identifier: Apache-2.0
"""Calls spread over processes and a Dask cluster: lost ones are repeated, others refused."""

from __future__ import annotations

import math
import os
import random
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
import typer
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from seed_cases import REAL_SEEDS
from seed_cases import TASK as SEEDS
from spread_cases import TASK, Case

from chaserdock.cli.simulate import simulate
from chaserdock.simulation import seeds
from chaserdock.simulation.flight import SimulationResult
from chaserdock.simulation.seed_table import opened_table
from chaserdock.simulation.seeds import SeedOptions, fly_seed
from chaserdock.simulation.swarm import draw_case
from chaserdock.spread import Lost, Places, ServedCall, spread
from chaserdock.version import difference, digest_of, version

TESTS = Path(__file__).resolve().parents[1]
OTHER = """
import chaserdock.version
chaserdock.version.sources_digest = lambda: "0f0e0d0c0b0a0908"
"""
"""``sitecustomize`` of a worker that has other sources."""
SHORT = """
extends = "single"
name = "short"
duration_s = 0.4
timeline = []
success = {docked = []}
"""


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the processes that a test starts import ``spread_cases`` and ``seed_cases``."""
    monkeypatch.setenv("PYTHONPATH", str(TESTS))


def children() -> list[psutil.Process]:
    """Processes that run calls for this one."""
    found = psutil.Process().children()
    return [child for child in found if TASK.module in child.cmdline()]


def test_one_job_calls_in_this_process_and_in_order() -> None:
    here = ServedCall("none", lambda item: (item, os.getpid()), int, tuple)
    assert list(spread(here, range(3))) == [(item, (item, os.getpid())) for item in range(3)]


def test_lost_processes_are_replaced_and_their_calls_repeated(tmp_path: Path) -> None:
    items = [Case("exit once", number, str(tmp_path / str(number))) for number in (1, 4)]
    assert dict(spread(TASK, items, Places(2))) == {items[0]: 1.0, items[1]: 2.0}
    assert children() == []


def test_what_has_no_result_is_lost_alone(tmp_path: Path) -> None:
    items = [Case("lose"), Case("root", -1.0), Case("root", 1.0), Case("kill")]
    results = dict(spread(TASK, items, Places(2)))
    assert [results[item] for item in items] == [
        Lost("lost"),
        Lost("ValueError: math domain error"),
        1.0,
        Lost("its process ended with status -9 (killed, as when memory is short)"),
    ]


def test_closing_ends_the_processes_at_once() -> None:
    items = [Case("root"), *[Case("sleep", 3600.0)] * 2]
    with closing(spread(TASK, items, Places(2))) as results:
        assert next(results) == (items[0], 0.0)
        assert len(children()) == 2
    assert children() == []


def test_none_begins_after_a_stop() -> None:
    stop = threading.Event()
    flown = []
    for item, _ in spread(TASK, [Case("root", k) for k in range(100)], Places(2), stop.is_set):
        flown.append(item)
        stop.set()
    assert 1 <= len(flown) <= 2


def test_error_of_a_call_ends_all() -> None:
    with pytest.raises(ChaserdockError, match=r"^nowhere: no such scenario file or shipped"):
        list(spread(TASK, [Case("refuse")], Places(2)))


def test_versions_differ_by_what_computes() -> None:
    ours = version()
    assert {"numpy", "scipy", "msgspec"} <= ours.keys()
    assert ours["Python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    for same in ({"commit": "other"}, {"chaserdock": "0.1"}, {"pymavlink": "0"}):
        theirs = {name: value for name, value in ours.items() if name not in same} | same
        ours_too = {name: value for name, value in ours.items() if name != "pymavlink"}
        assert difference(theirs, ours_too) == ""
    assert digest_of(ours) == digest_of(ours | {"commit": "other"})
    for name in ("numpy", "Python"):
        assert difference(ours | {name: "0"}, ours) == f"{name} 0, here {ours[name]}"
        assert digest_of(ours) != digest_of(ours | {name: "0"})
    assert difference({}, ours).startswith("chaserdock unknown of commit unknown (sources unknown)")


# -- Table of seeds --------------------------------------------------------------------------------


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SHORT)
    return path


def result_of(seed: int) -> SimulationResult:
    return SimulationResult(seed, {"extends": "single"}, (), "docked", "f", (), 1.0)


def test_cases_are_equal_after_json() -> None:
    scenario = load_scenario(find_scenario("fault-drill"))
    for seed in range(100):
        case = draw_case("fault-drill", seed, scenario)
        assert msgspec.json.decode(msgspec.json.encode(case)) == case


def test_cut_line_is_flown_again_and_other_rows_are_left_alone(short: Path, tmp_path: Path) -> None:
    path, options = tmp_path / "seeds.jsonl", SeedOptions(str(short))
    real = fly_seed(options, 1)
    with opened_table(path, options) as table:
        for result in (real, result_of(2), result_of(3)):
            table.add(result)
    with opened_table(path, SeedOptions(str(short), mode="realtime")) as other:
        assert other.results == {}
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    with opened_table(path, options) as table:
        assert table.results == {1: real, 2: result_of(2)}
        table.add(result_of(3))
    assert path.read_bytes() == whole
    short.write_text(SHORT.replace("0.4", "0.5"))
    with opened_table(path, options) as table:
        assert table.results == {}


def test_table_in_use_or_with_other_content_is_refused(short: Path, tmp_path: Path) -> None:
    path, options = tmp_path / "seeds.jsonl", SeedOptions(str(short))
    with (
        opened_table(path, options),
        pytest.raises(ChaserdockError, match="another simulation writes to it"),
        opened_table(path, options),
    ):
        pass
    path.write_text('{"seed": 1}\n')
    with (
        pytest.raises(ChaserdockError, match=r"seeds.jsonl: line 1 is no result of a seed \(.*"),
        opened_table(path, options),
    ):
        pass
    with (
        pytest.raises(ChaserdockError, match="cannot be written: Is a directory"),
        opened_table(tmp_path, options),
    ):
        pass


# -- Dask ------------------------------------------------------------------------------------------


@contextmanager
def cluster_of(workers: int) -> Iterator[Any]:
    from distributed import LocalCluster

    cluster: Any = LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0"
    )
    with cluster:
        yield cluster


@pytest.mark.slow
def test_each_seed_is_once_in_the_table_though_workers_are_killed(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Three kills cannot fail a seed: Dask gives up at the fourth."""
    monkeypatch.setattr(seeds, "_FLY", SEEDS)
    table, drawn, ended = tmp_path / "seeds.jsonl", random.Random(1), threading.Event()

    def rows() -> int:
        return table.read_bytes().count(b"\n") if table.exists() else 0

    def kill(cluster: Any) -> None:
        for least in (3, 20, 50):
            while rows() < least and not ended.wait(0.02):
                pass
            worker = drawn.choice(list(cluster.workers.values()))
            if not ended.is_set():
                os.kill(worker.pid, signal.SIGKILL)  # its nanny starts another one

    with cluster_of(2) as cluster:
        killer = threading.Thread(target=kill, args=(cluster,))
        killer.start()
        address = cluster.scheduler_address
        try:
            with pytest.raises(typer.Exit) as exit_:
                simulate(str(short), "1:100", cluster=address, results=table, out=tmp_path / "out")
        finally:
            ended.set()
            killer.join()
    said = capfd.readouterr()
    assert exit_.value.exit_code == 0, said
    assert "100 seeds in" in said.out
    options = SeedOptions(str(short))
    assert rows() == 100
    with opened_table(table, options) as found:
        assert sorted(found.results) == list(range(1, 101))
        for seed in REAL_SEEDS:
            assert found.results[seed] == fly_seed(options, seed)


@pytest.mark.slow
def test_workers_of_other_sources_are_refused_also_when_they_join_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER)
    with cluster_of(1) as cluster:
        address = cluster.scheduler_address
        refused = rf"^--cluster {address}: worker tcp://\S+ has chaserdock \S+ of commit \S+ "
        refused += rf"\(sources 0f0e0d0c\), here .* \(sources {version()['sources'][:8]}\)$"
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{TESTS}")
        items = (Case("root", number) for number in range(10**6))
        results = spread(TASK, items, Places(cluster=address))
        found = dict(next(results) for _ in range(3))
        cluster.scale(2)
        with pytest.raises(ChaserdockError, match=refused):
            found |= results
        assert all(result == math.sqrt(item.number) for item, result in found.items())
        with pytest.raises(ChaserdockError, match=refused):
            next(spread(TASK, [Case("root")], Places(cluster=address)))
