# SPDX-License-Identifier: Apache-2.0
"""Identified mass properties in a log: figure, report and viewer, beside the stated and the true
values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.codec import encode
from chaserdock_protocol.recording.log import LogWriter
from docking_cases import scenario
from msgspec.structs import replace

from chaserdock.analysis.figures import identification
from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.mass_properties import (
    PRIOR_ONLY,
    prior_sigmas,
    property_rows,
    stated_values,
)
from chaserdock.analysis.plots import MissingData
from chaserdock.analysis.report import report_of
from chaserdock.analysis.time_series import Traces
from chaserdock.viewer import plots, text
from chaserdock.viewer.history import History
from chaserdock.viewer.logged import LoggedMission

TRUE = (150.0, 0.06, -0.05, 0.04, 16.73, 20.29, 22.98, -2.41, 1.95, -1.41)


def mass_estimate(values: tuple[float, ...], share: float) -> m.MassEstimate:
    """An estimate with standard deviations of 1.5 kg, 2 mm and 0.1 kg m², times ``share``."""
    sigmas = share * np.array([1.5, *[0.002] * 3, *[0.1] * 6])
    return m.MassEstimate(
        mass_kg=values[0],
        centre_of_mass_m=(values[1], values[2], values[3]),
        inertia_kg_m2=values[4:],
        covariance=tuple(np.diag(sigmas**2).reshape(-1).tolist()),
    )


def stack_estimate(k: int) -> m.StackEstimate:
    """Errors and standard deviations shrink with time; the mass is two of the latter off."""
    share = 8.0 / (k + 1)
    values = (TRUE[0] + 2.0 * 1.5 * share, *TRUE[1:])
    return m.StackEstimate(
        tick=15 * k,
        seq=k,
        sim_time_ns=k * 10**9,
        chasers=(0,),
        stack=mass_estimate((values[0] + 10.0, *values[1:]), share),
        target=mass_estimate(values, share),
        thrust_factors=(1.0,) * 12,
    )


def drawn() -> m.DrawnTruth:
    inertia = (16.73, -2.41, 1.95, -2.41, 20.29, -1.41, 1.95, -1.41, 22.98)
    target = m.DrawnBody(
        body="target", mass_kg=150.0, inertia_kg_m2=inertia, centre_of_mass_m=(0.06, -0.05, 0.04)
    )
    return m.DrawnTruth(tick=0, bodies=(target,))


def made_log(path: Path, identified: int) -> Path:
    """A log of one chaser at rest, with so many estimates of the stack."""
    writer = LogWriter(path)
    known = {"mass_sigma_share": 0.5, "inertia_sigma_share": 1.0, "centre_of_mass_sigma_m": 0.1}
    mission = scenario(detumble={"identification": {"enabled": True}}, target=known)
    writer.describe(mission.model_dump_json(), {"mode": "lockstep"})

    def put(topic: topics.Topic, place: Any, message: Any) -> None:
        writer.write(
            topic.key_of(place),
            m.encoding_of(type(message)),
            encode(message),
            10**18 + message.sim_time_ns,
        )

    put(topics.TRUTH_DRAWN, None, drawn())
    for k in range(8):
        head: dict[str, Any] = {"seq": k, "tick": 15 * k, "sim_time_ns": k * 10**9}
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
        if k < identified:
            put(topics.STACK, None, stack_estimate(k))
    writer.close()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_log(tmp_path_factory.mktemp("identified") / "a.mcap", 8)


def test_figure_draws_the_estimates_with_their_bands(log: Path, tmp_path: Path) -> None:
    figure = identification(load_flight(log), Traces({}, {}, {}))
    _, top, middle, bottom = figure.axes  # phases, and panels
    mass = np.asarray(top.get_lines()[0].get_ydata())
    assert mass[[0, -1]] == pytest.approx([174.0, 153.0])
    true = [line for line in top.get_lines() if line.get_linestyle() == "--"]
    assert [np.asarray(line.get_ydata())[0] for line in true] == [150.0]
    band = top.collections[0].get_paths()[0].vertices
    assert np.asarray(band)[:, 1].min() == pytest.approx(150.0)
    assert len(middle.collections) == 3
    assert len(bottom.collections) == 6
    with pytest.raises(MissingData, match="no mass properties"):
        identification(load_flight(made_log(tmp_path / "b.mcap", 0)), Traces({}, {}, {}))


def test_report_has_a_table_of_identified_stated_and_true_values(log: Path) -> None:
    html = report_of(log)
    section = html[html.index('id="identified"') :]
    row = section[section.index("mass, kg") : section.index("centre x")]
    assert [
        x
        for x in ("153.0 ± 1.5", "40", "150", "+2.0 sigma", "163.0 ± 1.5")
        if f">{x}</td>" not in row
    ] == []
    assert "stack with chasers 0" in section


def test_values_that_the_flight_taught_nothing_about_say_so() -> None:
    """A standard deviation of 3.9 kg, where 4 kg were stated before the flight, is no
    measurement.
    """
    mission = scenario(target={"mass_sigma_share": 0.1, "inertia_sigma_share": 0.1})
    prior = prior_sigmas(mission)
    values, estimate = stated_values(mission), stack_estimate(7)
    sigmas = prior * np.array([0.97, *[0.5] * 3, 1.0, *[0.5] * 5])
    covariance = tuple(np.diag(sigmas**2).reshape(-1).tolist())
    body = m.MassEstimate(
        mass_kg=values[0],
        centre_of_mass_m=tuple(values[1:4].tolist()),
        inertia_kg_m2=tuple(values[4:].tolist()),
        covariance=covariance,
    )
    found = replace(estimate, target=body, stack=body)
    rows = property_rows(found, mission, None, "-")
    assert [r.name for r in rows if PRIOR_ONLY in r.target] == ["mass, kg", "Ixx, kg m²"]
    assert [r.name for r in rows if PRIOR_ONLY in r.stack] == ["mass, kg", "Ixx, kg m²"]


def test_viewer_shows_the_latest_values_and_their_convergence(log: Path) -> None:
    mission = LoggedMission(log)
    at_end, at_begin = (text.mass_properties(mission.scenario, mission.at(t)) for t in (7.5, 1.5))
    assert "| mass, kg | 153.0 ± 1.5 | 40 | 150 | 163.0 ± 1.5 |" in at_end
    assert "| mass, kg | 162.0 ± 6.0 |" in at_begin
    (plot,) = (
        p for p in plots.plots_of(1, True, [0], True) if p.curves[0][2] == "mass_sigma_percent"
    )
    times, mass, centre, inertia = plots.points_of(plot, mission.history, 0.0, mission.end_s)
    assert times.size == 8
    assert mass[-1] == pytest.approx(100.0 * 1.5 / 153.0)
    assert centre[[0, -1]] == pytest.approx([16.0, 2.0])
    assert inertia[-1] == pytest.approx(100.0 * 0.1 / 22.98)
    assert not any(p.curves[0][2] == "mass_sigma_percent" for p in plots.plots_of(1, True, [0]))
    assert not History(1).series["mass_sigma_percent", None].until(1.0)[0].size
