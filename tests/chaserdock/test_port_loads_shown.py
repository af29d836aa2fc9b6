# SPDX-License-Identifier: Apache-2.0
"""Loads at the ports in a log: summary, figure and viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.codec import encode
from chaserdock_protocol.recording.log import LogWriter
from chaserdock_protocol.scenario import ScenarioError
from docking_cases import PORTS, scenario

from chaserdock.analysis.figures import loads
from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.plots import MissingData
from chaserdock.analysis.summary import summarize
from chaserdock.analysis.time_series import Traces
from chaserdock.summary import Summary
from chaserdock.viewer import plots
from chaserdock.viewer.history import History
from chaserdock.viewer.logged import LoggedMission

TICK_NS = 1_000_000_000 // 15
FORCES_N = (0.0, 0.0, 3.5, 0.5)


def load_at(k: int, force_N: float) -> m.PortLoad:
    return m.PortLoad(
        seq=k,
        tick=k,
        sim_time_ns=k * TICK_NS,
        chaser=0,
        force_N=(0.1, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
        peak_force_N=force_N,
        peak_torque_N_m=0.2 * force_N,
        peak_axial_N=0.6 * force_N,
        peak_shear_N=0.8 * force_N,
        peak_bending_N_m=0.1 * force_N,
        closing_impulse_N_s=0.12 if k == 2 else 0.0,
    )


def made_log(
    path: Path, forces_N: tuple[float, ...], measured: bool = True, **changes: Any
) -> Path:
    """A log of one chaser at rest with these peak forces, one a tick."""
    writer = LogWriter(path)
    writer.describe(scenario(**changes).model_dump_json(), {"mode": "lockstep"})

    def put(topic: topics.Topic, place: Any, message: Any) -> None:
        writer.write(
            topic.key_of(place),
            m.encoding_of(type(message)),
            encode(message),
            10**18 + message.sim_time_ns,
        )

    for k, force_N in enumerate(forces_N):
        head: dict[str, Any] = {"seq": k, "tick": k, "sim_time_ns": k * TICK_NS}
        rest: dict[str, Any] = {
            "velocity_m_s": (0, 0, 0),
            "q_wxyz": (1, 0, 0, 0),
            "omega_rad_s": (0, 0, 0),
        }
        put(topics.TICK, None, m.Tick(**head, images=False, chasers=(0,)))
        for name, x in (("target", 0.0), ("chaser/0", -1.0)):
            put(
                topics.TRUTH_BODY,
                name,
                m.BodyTruth(**head, **rest, body=name, position_m=(x, 0.0, 0.0)),
            )
        put(topics.TRUTH_WORLD, None, m.WorldTruth(**head, contacts=(), saturated=(), latched=(0,)))
        if measured:
            put(topics.TRUTH_LOAD, 0, load_at(k, force_N))
    writer.close()
    return path


def test_summary_has_the_peaks(tmp_path: Path) -> None:
    result = summarize(made_log(tmp_path / "a.mcap", FORCES_N))
    assert result["chasers"]["0"]["capture"]["port_load"] == pytest.approx(
        {
            "peak_force_N": 3.5,
            "peak_torque_N_m": 0.7,
            "peak_axial_N": 2.1,
            "peak_shear_N": 2.8,
            "peak_bending_N_m": 0.35,
            "closing_impulse_N_s": 0.12,
            "limit_exceeded_s": None,
        }
    )
    capture = Summary.from_dict(result).chasers[0].capture
    assert capture is not None
    assert capture.port_load is not None
    assert capture.port_load.peak_force_N == 3.5


def limited(**limits: float) -> dict[str, Any]:
    return {"docking": {"ports": [PORTS[0] | limits]}}


@pytest.mark.parametrize(
    ("limits", "failures"),
    [
        ({"force_limit_N": 3.6, "torque_limit_N_m": 0.71}, []),
        (
            {"force_limit_N": 3.4},
            [
                "force on the port, chaser 0: 3.50 N, at most 3.4 N; exceeded from 0.13 s on",
            ],
        ),
        (
            {"torque_limit_N_m": 0.05},
            [
                "torque on the port, chaser 0: 0.700 N m, at most 0.05 N m; exceeded from "
                "0.13 s on",
            ],
        ),
    ],
)
def test_exceeded_limits_are_failures(
    tmp_path: Path, limits: dict[str, float], failures: list[str]
) -> None:
    result = summarize(made_log(tmp_path / "a.mcap", FORCES_N, **limited(**limits)))
    assert [x for x in result["failures"] if "port" in x] == failures
    peaks = result["chasers"]["0"]["capture"]["port_load"]
    assert peaks["limit_exceeded_s"] == (pytest.approx(2 / 15, abs=1e-6) if failures else None)


def test_limits_without_loads_in_the_log_are_not_met(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", FORCES_N, measured=False, **limited(force_limit_N=5.0))
    result = summarize(log)
    assert result["chasers"]["0"]["capture"]["port_load"] is None
    assert "force on the port, chaser 0: not known, at most 5 N" in result["failures"]


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (
            {"force_limit_N": 0.01},
            "docking.ports.0.force_limit_N: 0.01 N is less than the 0.0194 N that the tumble of "
            "3.22 degrees/s alone "
            "exerts on the port of chaser 0",
        ),
        (
            {"torque_limit_N_m": 1e-4},
            "docking.ports.0.torque_limit_N_m: 0.0001 N m is less than the 0.000",
        ),
        ({"force_limit_N": 0.0}, "docking.ports.0.force_limit_N"),
        ({"torque_limit_N_m": float("inf")}, "docking.ports.0.torque_limit_N_m"),
    ],
)
def test_limit_below_the_tumble_is_one_line(limits: dict[str, float], message: str) -> None:
    with pytest.raises(ScenarioError) as error:
        scenario(**limited(**limits))
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1
    scenario(**limited(force_limit_N=0.02, torque_limit_N_m=1e-3))


def test_figure_draws_each_port_and_needs_a_load(tmp_path: Path) -> None:
    figure = loads(load_flight(made_log(tmp_path / "a.mcap", FORCES_N)), Traces({}, {}, {}))
    _, top, bottom = figure.axes  # phases, and panels
    force, shear = top.get_lines()[:2]
    assert np.asarray(force.get_ydata()).tolist() == list(FORCES_N)
    assert np.asarray(shear.get_ydata()).tolist() == pytest.approx([0.8 * f for f in FORCES_N])
    assert np.asarray(bottom.get_lines()[0].get_ydata()).tolist() == pytest.approx(
        [0.2 * f for f in FORCES_N]
    )
    nothing = load_flight(made_log(tmp_path / "b.mcap", (0.0, 0.0)))
    with pytest.raises(MissingData, match="no chaser has loaded a port"):
        loads(nothing, Traces({}, {}, {}))


def test_viewer_plots_loads_of_chasers_with_a_port_only_with_truth(tmp_path: Path) -> None:
    mission = LoggedMission(made_log(tmp_path / "a.mcap", FORCES_N))
    (plot,) = (p for p in plots.plots_of(2, True, [0]) if p.curves[0][2] == "port_load_N")
    assert [chaser for *_, chaser in plot.curves] == [0]
    _, values = plots.points_of(plot, mission.history, 0.0, mission.end_s)
    assert values.max() == 3.5
    for shown in (plots.plots_of(2, False, [0]), plots.plots_of(2, True)):
        assert not any(p.curves[0][2] == "port_load_N" for p in shown)
    assert not History(1).series["port_load_N", 0].until(1.0)[0].size
