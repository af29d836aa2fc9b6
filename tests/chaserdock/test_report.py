# SPDX-License-Identifier: Apache-2.0
"""Figures, report page and film of recorded flights: whole, cut short, or with hardly anything in
them.
"""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import av
import cv2
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import target_model
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.codec import encode
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.recording.log import LogError, LogWriter
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from flight_cases import scenario
from fontTools.ttLib import TTFont
from harness import ROOT, finished
from matplotlib.colors import to_hex
from motion_cases import track, true_motion
from scipy.stats import chi2

from chaserdock.analysis.approach import approach_of
from chaserdock.analysis.body_renderer import BodyRenderer
from chaserdock.analysis.charts import ChartData
from chaserdock.analysis.chase_camera import Viewpoint
from chaserdock.analysis.dressed_bodies import chaser_body, target_body
from chaserdock.analysis.figures import (
    FIGURES,
    _FewTicks,
    approach,
    cameras,
    consistency_text,
    docking,
    inputs,
    keep_out,
    speed_limits,
    thrusters,
    tracking,
    write_figures,
)
from chaserdock.analysis.flight import RecordedFlight, ReferenceHistory, load_flight
from chaserdock.analysis.images import columns_for, pairs, shots
from chaserdock.analysis.plots import AXES_XYZ, SERIES, MissingData, new_figure, save
from chaserdock.analysis.report import _chasers, report_of, table, write_report
from chaserdock.analysis.summary import summary_of, text_of, tracking_components, tracking_errors
from chaserdock.analysis.time_series import (
    OUTCOMES,
    ActuatorHistory,
    ImageOutcomes,
    Traces,
    load_traces,
)
from chaserdock.analysis.video import Film, film_of, wrapped, write_video
from chaserdock.criterion import quantity
from chaserdock.verdict import Verdict

TICK_NS = 1_000_000_000 // 15
SIZE: dict[str, Any] = {"width_px": 96, "height_px": 64}
ONE = scenario(chasers=[{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}])


def put(writer: LogWriter, topic: topics.Topic, place: Any, message: Any) -> None:
    writer.write(
        topic.key_of(place),
        m.encoding_of(type(message)),
        encode(message),
        10**18 + message.sim_time_ns,
    )


def made_log(
    path: Path, ticks: int, seen: bool = False, chasers: int = 1, truth: bool = True
) -> Path:
    """A log with images of nothing: chaser i at -1 - i m, at rest, and a target that drifts along
    z.
    """
    values = {"description": "made <&>", "duration_s": 2.0, "camera": SIZE}
    names = [
        {"position_m": [-1.0 - i, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for i in range(chasers)
    ]
    writer = LogWriter(path)
    writer.describe(scenario(**values, chasers=names).model_dump_json(), {"mode": "lockstep"})
    for k in range(ticks):
        head: dict[str, Any] = {"seq": k, "tick": k, "sim_time_ns": k * TICK_NS}
        rest: dict[str, Any] = {
            "velocity_m_s": (0, 0, 0),
            "q_wxyz": (1, 0, 0, 0),
            "omega_rad_s": (0, 0, 0),
        }
        if truth:
            body = m.BodyTruth(**head, **rest, body="target", position_m=(0.0, 0.0, 0.03 * k / 15))
            put(writer, topics.TRUTH_BODY, "target", body)
        for i in range(chasers):
            if truth:
                body = m.BodyTruth(
                    **head,
                    **rest,
                    body=f"chaser/{i}",
                    position_m=(-1.0 - i, 0, 0),
                    impulse_N_s=(0.1, 0.0, 0.0),
                )
                put(writer, topics.TRUTH_BODY, f"chaser/{i}", body)
            image = m.Image(**head, chaser=i, **SIZE, encoding="mono8", data=bytes(96 * 64))
            put(writer, topics.IMAGE, i, image)
            sighting = m.Sighting(
                **head,
                chaser=i,
                status="seen" if seen else "nothing",
                solutions=(),
                marker_ids=(0,) if seen else (),
                corners_px=(10.0, 10.0, 20.0, 10.0, 20.0, 20.0, 10.0, 20.0) if seen else (),
                rejected_ids=(),
            )
            put(writer, topics.SIGHTING, i, sighting)
    writer.close()
    return path


class Page(HTMLParser):
    """What a page refers to, its ids and its embedded data."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.references: list[str] = []
        self.open: list[str] = []
        self.data = ""
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("src", "href", "xlink:href", "srcset", "action", "data", "poster"):
                self.references.append(value or "")

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script" and data.lstrip().startswith('{"times"'):
            self.data = data
        else:
            self.words += data


def checked(text: str) -> Page:
    """A page that refers to nothing outside itself, has every id once and every target of its
    links.
    """
    page = Page(text)
    assert len(page.ids) == len(set(page.ids))
    for reference in page.references:
        assert reference.startswith(("#", "data:")), reference
        assert not reference.startswith("#") or reference[1:] in page.ids, reference
    for inside in re.findall(r"url\(([^)]*)\)", text):
        assert inside.startswith("#"), inside
        assert inside[1:] in page.ids, inside
    assert "@import" not in text
    assert "default-src 'none'" in text
    # Not even a name space or a comment names a host, so nothing can be fetched by a slip.
    assert (
        re.findall(r"https?://[^\s\"'<]*", re.sub(r"<pre>.*?</pre>", "", text, flags=re.DOTALL))
        == []
    )
    return page


@pytest.fixture(scope="module")
def page(short_flight: Path) -> Page:
    return checked(report_of(short_flight / "mission.mcap"))


def test_report_has_every_figure_and_no_external_reference(short_flight: Path, page: Page) -> None:
    drawn = {i for i in page.ids if i.startswith("figure-")}
    # Not in every log: the flight of the fixture neither approaches nor latches.
    others = (
        "thrusters", "loads", "passive_safety", "assurance", "identification", "approach", "stack",
    )  # fmt: skip
    assert drawn >= {f"figure-{k.name}" for k in FIGURES if k.name not in others}
    assert {"replay-section", "events", "scenario", "versions"} <= set(page.ids)
    assert json.loads((short_flight / "summary.json").read_text())["digest"] in page.words


def test_replay_data_equal_the_recorded_motion(short_flight: Path, page: Page) -> None:
    data = json.loads(page.data)
    truth = load_flight(short_flight / "mission.mcap").motion
    assert np.all(np.diff(data["times"]) > 0)
    assert data["times"][-1] == pytest.approx(truth["target"].time_s[-1], abs=1e-3)
    assert [c["id"] for c in data["chasers"]] == [0, 1]
    for body, name in ((data["target"], "target"), (data["chasers"][1], "chaser/1")):
        rows = np.searchsorted(truth[name].time_s, np.array(data["times"]) - 1e-3)
        np.testing.assert_allclose(
            np.reshape(body["p"], (-1, 3)), truth[name].position_m[rows], atol=1e-4
        )
        np.testing.assert_allclose(
            np.reshape(body["q"], (-1, 4)), truth[name].q_wxyz[rows], atol=1e-4
        )
    assert set(data["images"]["chasers"]) == {"0", "1"}
    for urls in data["images"]["chasers"].values():
        assert len(urls) == len(data["images"]["times"]) > 0
        assert all(url.startswith("data:image/jpeg;base64,") for url in urls)


def test_replay_draws_the_bodies_of_the_film(short_flight: Path, page: Page) -> None:
    data, flown = json.loads(page.data), load_flight(short_flight / "mission.mcap").scenario
    shown = [(data["target"]["body"], target_body(flown))]
    shown += [(data["chasers"][i]["body"], chaser_body(flown, i)) for i in (0, 1)]
    for stored, body in shown:
        found = zip(stored["coats"], body.surfaces().items(), strict=True)
        for k, (coat, soup) in found:
            assert k["rgb"] == list(coat.rgb)
            units = np.frombuffer(base64.b64decode(data["arrays"][k["corners"]]), dtype="<i2")
            corners = stored["unit_m"] * units.reshape(-1, 3, 3)
            np.testing.assert_allclose(corners, soup.corners_m, atol=4e-5)


def test_every_figure_is_described() -> None:
    text = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    assert [k.name for k in FIGURES if f"`{k.name}`" not in text] == []


@pytest.mark.slow
def test_equal_logs_give_equal_reports(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 4)
    assert report_of(log) == report_of(log)


@pytest.mark.slow
def test_truncated_log_gives_a_report(short_flight: Path, tmp_path: Path) -> None:
    whole = (short_flight / "mission.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(0.6 * len(whole))])
    page = checked(report_of(cut))
    assert "FAILED" in page.words
    assert "the log ends before the mission does" in page.words


@pytest.mark.slow
def test_report_of_a_flight_without_sightings_names_what_is_missing(tmp_path: Path) -> None:
    page = checked(report_of(made_log(tmp_path / "blind.mcap", 8)))
    assert {"figure-tracking", "figure-cameras", "figure-inputs", "replay"} <= set(page.ids)
    assert "figure-estimate" not in page.ids
    assert "target was never estimated" in page.words
    assert "made <&>" in page.words  # escaped on the way, or it would be gone


@pytest.mark.slow
@pytest.mark.parametrize("ticks", [0, 1])
def test_flight_aborted_at_once_gives_a_report(tmp_path: Path, ticks: int) -> None:
    page = checked(report_of(made_log(tmp_path / "aborted.mcap", ticks)))
    assert "the log ends before the mission does, at 0.00 s" in page.words
    assert ("replay" in page.ids) == (ticks > 0)


def test_report_of_a_log_without_truth_names_what_is_missing(tmp_path: Path) -> None:
    page = checked(report_of(made_log(tmp_path / "dark.mcap", 5, truth=False)))
    assert "neither ground truth nor a reference of the target" in page.words
    assert "figure-cameras" in page.ids


def test_tables_escape_their_cells() -> None:
    assert "&lt;b&gt;" in table(("<b>",), [("<b>", "&")])
    assert "<b>" not in table(("<b>",), [("<b>", "&")])


@pytest.mark.skipif(
    shutil.which("chromium") is None, reason="no chromium on PATH: structure alone is checked"
)
def test_replay_runs_in_a_browser(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    text = report_of(made_log(tmp_path / "a.mcap", 5, chasers=2))
    zoom = "document.querySelector('#plot-docking .zoom button').click();"
    seek = "document.dispatchEvent(new CustomEvent('replay-seek', {detail: 0.2}));"
    script = f"<script>{zoom}{seek}</script></body>"
    page.write_text(text.replace("</body>", script), encoding="utf-8")
    options = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=2000",
        "--dump-dom",
    ]
    command = ["chromium", *options, f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert '<span id="replay-clock">0.2 s</span>' in dom
    # Two charts of uPlot with the values at that time; the cursor of the other figures is there.
    charts = dom[dom.index('id="plot-docking"') : dom.index('id="figure-separation"')]
    assert charts.count("<canvas") == 2
    assert ">0.20</td>" in charts
    assert ">1.000</td>" in charts
    assert re.search(r'class="panel"[^>]*><i style="left: 7[0-9.]*%;"', dom)
    assert re.search(r'<tr id="replay-row-1"><th[^>]*>chaser 1</th><td>–</td><td>2.000 m</td>', dom)  # noqa: RUF001


# -- figures ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_figures_are_written_in_the_requested_format(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 8, chasers=2)
    for ending, begins in (("svg", b"<?xml"), ("pdf", b"%PDF")):
        files, missing = write_figures(log, tmp_path / ending, ending)
        assert {f.stem for f in files} | set(missing) == {k.name for k in FIGURES}
        assert {"tracking", "docking", "separation", "inputs", "cameras"} <= {f.stem for f in files}
        assert all(f.read_bytes().startswith(begins) for f in files)
        if ending == "svg":
            assert all(ElementTree.parse(f).getroot().tag.endswith("svg") for f in files)


def test_pdf_and_svg_contain_truetype(tmp_path: Path) -> None:
    figure, (axes,) = new_figure(1)
    axes.set_title("offset ≤ 8 mm")
    for ending in ("pdf", "svg"):
        save(figure, tmp_path / f"a.{ending}")
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    svg = (tmp_path / "a.svg").read_text()
    embedded = re.search(r"@font-face\{[^}]*base64,([^)]*)\)", svg)
    assert embedded is not None
    font = TTFont(io.BytesIO(base64.b64decode(embedded[1])))
    assert {ord(letter) for letter in "offset ≤ 8 mm"} <= set(font.getBestCmap() or ())
    assert len(embedded[1]) < 60_000
    assert ElementTree.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")


def test_colours_of_chasers_stand_for_nothing_else(tmp_path: Path) -> None:
    """Neither for x, y, z nor for outcomes of images or quantities of the flight."""
    assert set(AXES_XYZ).isdisjoint(SERIES)
    log = made_log(tmp_path / "a.mcap", 8, chasers=2)
    flight, traces = load_flight(log), load_traces(log, ONE)
    forces, outcomes = inputs(flight, traces), cameras(flight, traces).axes[0]
    steps: list[Any] = [patch.get_edgecolor() for axes in forces.axes for patch in axes.patches]
    bars = [colour for bars in outcomes.collections for colour in bars.get_facecolor()]
    assert len(steps) == 2 * 3
    drawn: list[Any] = [*steps, *bars]
    assert {to_hex(colour) for colour in drawn}.isdisjoint(SERIES)


def phases_flight(path: Path, chasers: int) -> RecordedFlight:
    """A flight of 20 s whose chasers change their phases often, and at the same times."""
    flight = load_flight(made_log(path, 301, chasers=chasers))
    phases = [(0.0, "hold"), (2.0, "approach"), (2.2, "align"), (2.4, "final"), (12.0, "latched")]
    history = ReferenceHistory(np.zeros(1), np.ones((1, 3)), phases, np.zeros((1, 2)))
    flight.references = dict.fromkeys(range(chasers), history)
    return flight


def test_names_of_phases_do_not_overlap_and_stay_within_the_axes(tmp_path: Path) -> None:
    flight = phases_flight(tmp_path / "a.mcap", 2)
    figure = docking(flight, Traces({}, {}, {}))
    figure.draw_without_rendering()
    strip = figure.axes[0]
    names = [t for t in strip.texts if not t.get_text().startswith("chaser")]
    assert sorted(t.get_text() for t in names) == sorted(["hold", "final", "latched"] * 2)
    boxes, around = [t.get_window_extent() for t in names], strip.get_window_extent()
    for k, box in enumerate(boxes):
        assert around.x0 <= box.x0 < box.x1 <= around.x1
        assert around.y0 <= box.y0 < box.y1 <= around.y1
        assert not any(box.overlaps(other) for other in boxes[:k])
    assert {t.get_text().strip() for t in strip.texts} >= {"chaser 0", "chaser 1"}


def test_transient_does_not_set_the_scale_of_errors(tmp_path: Path) -> None:
    flight = phases_flight(tmp_path / "a.mcap", 1)
    success = flight.scenario.success.model_copy(update={"steady_position_rms_m": 1e-4})
    changes = {"settling_s": 10.0, "success": success}
    flight.scenario = flight.scenario.model_copy(update=changes)
    times = np.arange(301) / 15.0
    error = np.where(times < 8.0, 0.5, 0.001)
    flight.estimated_errors = {0: np.stack([times, error, error], axis=1)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "chaserdock.analysis.figures.tracking_errors", lambda *_: (times, error, error)
        )
        figure = tracking(flight, Traces({}, {}, {}))
    whole, late = figure.axes[2:4]
    assert late.get_ylabel() == whole.get_ylabel() == "position error / mm"
    assert 1.0 < late.get_ylim()[1] < 1.5
    assert whole.get_ylim()[0] < 0.1  # the limit is in the picture


def test_charts_have_the_values_of_the_figures(tmp_path: Path) -> None:
    flight = load_flight(made_log(tmp_path / "a.mcap", 301, chasers=2))
    figure = docking(flight, Traces({}, {}, {}))
    figure.draw_without_rendering()
    charts = ChartData()
    charts.add("docking", figure)
    panel, _ = charts.figures["docking"]
    assert [curve["label"] for curve in panel["curves"]][-2:] == ["chaser 0", "chaser 1"]
    curve = panel["curves"][-1]
    assert curve["colour"] == "--series-1"
    x, y = (
        np.frombuffer(base64.b64decode(charts.pool.arrays[curve[k]]), dtype="<f4")
        for k in ("x", "y")
    )
    time_s, distance_m = flight.motion["chaser/1"].distance_to(flight.motion["target"])
    np.testing.assert_allclose(x, time_s, rtol=1e-6)
    np.testing.assert_allclose(y, distance_m, rtol=1e-6)
    assert panel["x"]["ends"] == [0.0, pytest.approx(20.0)]


def test_charts_are_of_any_x_axis_and_have_bars(tmp_path: Path) -> None:
    """Over a range that runs to the right in time, and with an image's outcome in each row."""
    flight = with_references(
        tmp_path / "a.mcap", "docking-contact", [(0.0, "hold"), (1.0, "final")]
    )
    charts, traces = ChartData(), load_traces(tmp_path / "a.mcap", flight.scenario)
    for name, draw in (("approach", approach), ("cameras", cameras)):
        figure = draw(flight, traces)
        figure.draw_without_rendering()
        charts.add(name, figure)
    lateral, closing = charts.figures["approach"]
    assert lateral["over"] == closing["over"] == "range / mm"
    assert (lateral["x"]["direction"], lateral["time"]) == (-1, False)
    assert [limit["x"] for limit in lateral["limits"]][-1] == [0.0, 0.0]  # at contact
    top, _ = charts.figures["cameras"]
    assert top["time"]
    assert top["y"]["names"] == [(0.0, "chaser 0")]
    (bar,) = top["bars"]
    assert bar["y"] == pytest.approx([-0.36, 0.36])
    assert bar["colour"] == "--grid"  # nothing seen


def test_approach_is_measured_from_the_port(tmp_path: Path) -> None:
    """The tip comes along the axis at 20 mm/s, 5 mm off it, and touches at 15 s."""
    flight = with_references(
        tmp_path / "a.mcap", "docking-contact", [(0.0, "hold"), (5.0, "final")]
    )
    s, times = flight.scenario, np.arange(301) / 15.0
    port = s.docking.ports[0]
    gap = 0.02 * (15.0 - times)
    centres = np.array([centre_offset(port, s.chaser.probe_reach_m, g) for g in gap])
    centres += [0.0, 0.003, 0.004]
    chaser, target = track(times, position_m=centres), track(times)
    flight.motion = true_motion({"target": target, "chaser/0": chaser})
    found = approach_of(flight, 0)
    assert found is not None
    assert found.time_s[0] == pytest.approx(5.0)
    np.testing.assert_allclose(found.range_m, 0.02 * (15.0 - found.time_s), atol=1e-9)
    np.testing.assert_allclose(found.lateral_m, 0.005, atol=1e-9)
    np.testing.assert_allclose(found.closing_m_s, 0.02, atol=1e-9)
    assert [limit.value for limit in found.lateral_limits] == [0.03, 0.008, 0.01]
    assert approach_of(flight, 1) is None


def test_forces_are_impulses_divided_by_tick_durations(tmp_path: Path) -> None:
    given = load_traces(made_log(tmp_path / "a.mcap", 5), ONE).inputs[0]
    assert given.edges_s.shape == (5,)
    np.testing.assert_allclose(given.force_N, np.tile([1.5, 0.0, 0.0], (4, 1)), rtol=1e-6)
    assert given.thruster_duty.shape == (4, 0)


def test_every_image_has_an_outcome(tmp_path: Path) -> None:
    nothing = load_traces(made_log(tmp_path / "a.mcap", 4), ONE).image_outcomes[0]
    assert {OUTCOMES[code] for code in nothing.code} == {"not seen"}
    seen = load_traces(made_log(tmp_path / "b.mcap", 4, seen=True), ONE).image_outcomes[0]
    assert list(seen.intervals()) == [(0.0, 3 * TICK_NS / 1e9, "used")]
    np.testing.assert_array_equal(seen.time_s, [k * TICK_NS / 1e9 for k in range(4)])


def test_intervals_end_at_changes_and_gaps() -> None:
    outcomes = ImageOutcomes(np.array([0.0, 1.0, 2.0, 3.0, 7.0]), np.array([0, 0, 2, 2, 2]))
    assert list(outcomes.intervals()) == [(0.0, 1.0, "used"), (2.0, 7.0, "not seen")]
    assert list(outcomes.intervals(1.5)) == [
        (0.0, 1.0, "used"),
        (2.0, 3.0, "not seen"),
        (7.0, 7.0, "not seen"),
    ]
    assert list(ImageOutcomes(np.zeros(0), np.zeros(0, dtype=np.intp)).intervals()) == []


def test_forces_over_several_ticks_are_means(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 8)
    one, three = (load_traces(log, ONE, every).inputs[0] for every in (1, 3))
    np.testing.assert_array_equal(three.edges_s, one.edges_s[::3])
    np.testing.assert_allclose(
        three.force_N, one.force_N[:6].reshape(2, 3, 3).mean(axis=1), rtol=1e-12
    )


def test_thruster_figure_shows_duty_cycles(tmp_path: Path) -> None:
    flight = load_flight(made_log(tmp_path / "a.mcap", 5))
    traces = load_traces(tmp_path / "a.mcap", ONE)
    with pytest.raises(MissingData, match="no thrusters"):
        thrusters(flight, traces)
    duty = np.linspace(0.0, 1.0, 24).reshape(2, 12)
    given = ActuatorHistory(np.array([0.0, 1.0, 2.0]), np.zeros((2, 3)), np.zeros((2, 3)), duty)
    figure = thrusters(flight, Traces({0: given}, {}, {}))
    drawn: Any = figure.axes[0].collections[0]
    np.testing.assert_array_equal(np.reshape(drawn.get_array(), (12, 2)), duty.T)


def with_references(path: Path, shipped: str, phases: list[tuple[float, str]]) -> RecordedFlight:
    """A flight of 20 s in a shipped scenario with these phases; the keep-out distance falls at 10 s
    and ends at 15 s.
    """
    flight = load_flight(made_log(path, 301))
    flight.scenario = load_scenario(find_scenario(shipped))
    keep_out = np.array([[0.0, 0.75], [10.0, 0.5], [15.0, 0.0]])
    flight.references = {0: ReferenceHistory(np.zeros(1), np.ones((1, 3)), phases, keep_out)}
    return flight


def test_docking_figure_draws_the_limits_of_each_moment(tmp_path: Path) -> None:
    phases = [(0.0, "hold"), (5.0, "approach"), (10.0, "final"), (15.0, "verified")]
    flight = with_references(tmp_path / "a.mcap", "docking-contact", phases)
    time_s, limit_m = keep_out(flight, 0)
    np.testing.assert_allclose(time_s, [0.0, 10.0, 15.0, 20.0], atol=1e-6)
    np.testing.assert_array_equal(limit_m, [0.75, 0.5, np.nan, np.nan])
    limits = flight.scenario.docking
    expected = [(5.0, 10.0, limits.corridor.closing_m_s), (10.0, 15.0, limits.final.closing_m_s)]
    assert speed_limits(flight, 0) == expected
    figure = docking(flight, load_traces(tmp_path / "a.mcap", ONE))
    # The distance at which chasers without a port hold does not apply to this one.
    assert not [t for t in figure.axes[1].texts if "docking distance" in t.get_text()]


def test_docking_figure_draws_the_docking_distance_of_chasers_without_a_port(
    tmp_path: Path,
) -> None:
    flight = with_references(
        tmp_path / "a.mcap", "four-chaser-docking", [(0.0, "hold"), (5.0, "approach")]
    )
    figure = docking(flight, load_traces(tmp_path / "a.mcap", ONE))
    assert [t for t in figure.axes[1].texts if "docking distance" in t.get_text()]
    ((begin_s, _, limit),) = speed_limits(flight, 0)
    assert (begin_s, limit) == (5.0, flight.scenario.approach.max_speed_m_s)


@pytest.mark.parametrize(
    ("scale", "verdict"), [(1.0, "consistent"), (4.0, "overconfident"), (0.1, "conservative")]
)
def test_consistency_is_judged_on_both_sides(scale: float, verdict: str) -> None:
    nees = scale * np.random.default_rng(1).chisquare(6, 20_000)
    low, high = chi2.ppf((0.025, 0.975), df=6)
    assert consistency_text(nees, low, high).startswith(f"{verdict}: mean")


def test_errors_by_axis_have_the_length_of_the_errors(short_flight: Path) -> None:
    flight = load_flight(short_flight / "mission.mcap")
    time_s, position, angle = tracking_errors(flight, 1)
    by_axis_s, offset, turn = tracking_components(flight, 1, 3)
    np.testing.assert_array_equal(by_axis_s, time_s[::3])
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), position[::3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turn, axis=1), angle[::3], rtol=1e-6, atol=1e-9)


def test_captured_chaser_is_reported_by_its_latch(tmp_path: Path) -> None:
    capture = {
        "latched": True,
        "verified": True,
        "latch_time_s": 40.02,
        "contact_lateral_m": 0.0012,
        "contact_angle_rad": 0.01,
        "contact_closing_m_s": 0.0101,
        "contact_lateral_speed_m_s": 0.001,
        "probe_touches": 1,
    }
    flight = load_flight(made_log(tmp_path / "a.mcap", 3))
    result = summary_of(flight)
    result["chasers"]["0"] |= {"capture": capture, "propellant_kg": 0.0123}
    text = _chasers(flight, result)
    for part in ("verified", "40.02 s", "1.20 mm", "0.573 °", "10.1 mm/s", "12.3 g"):
        assert part in text
    assert "docking pose since" not in text
    assert "docking pose since" in _chasers(flight, summary_of(flight))


def test_figures_of_a_published_task_are_reported_and_part_of_the_line(tmp_path: Path) -> None:
    flight = load_flight(made_log(tmp_path / "a.mcap", 3))
    result = summary_of(flight)
    assert "Rendezvous" not in _chasers(flight, result)
    result["chasers"]["0"]["rendezvous"] = {
        "speed_margin_m_s": 0.0575,
        "cone_angle_rad": 0.2,
        "arrived_s": 1121.6,
        "arrived_speed_m_s": 0.0163,
        "abort_s": None,
        "abort_clear_m": 3.25,
    }
    text = _chasers(flight, result)
    for part in ("Rendezvous", "57.5 mm/s", "11.5 °", "1121.6 s", "16.3 mm/s", "3.25 m"):
        assert part in text
    line = " ".join(text_of(result).split())
    assert (
        "least margin to the speed limit 0.058 m/s; at most 11.46° off the cone's axis; arrived "
        "at 1121.6 s" in line
    )
    assert "aborted" not in line


def test_quantities_have_three_digits_and_no_exponent() -> None:
    texts = [quantity(value, "ms", 1e3) for value in (None, 0.0, 2.3e-5, 0.0851, 0.4, 2.3014, 71.0)]
    assert texts == [
        "\N{EN DASH}",
        "0.00 ms",
        "0.0230 ms",
        "85.1 ms",
        "400 ms",
        "2301 ms",
        "71000 ms",
    ]


def test_labels_of_a_distribution_do_not_touch() -> None:
    assert list(_FewTicks().tick_values(1.0, 90.0))[:3] != [0.1, 1.0, 10.0]
    assert [float(v) for v in _FewTicks().tick_values(0.2, 1000.0) if 0.2 <= v <= 1000.0] == [
        1.0,
        10.0,
        100.0,
        1000.0,
    ]


# -- images and video ------------------------------------------------------------------------------


def test_images_are_paired_with_sightings_of_the_same_exposure(short_flight: Path) -> None:
    found = list(pairs(short_flight / "mission.mcap", 2))
    counts = load_flight(short_flight / "mission.mcap").counts
    assert len(found) == counts["world/chaser/0/image"] + counts["world/chaser/1/image"]
    for image, sighting in found:
        assert sighting is not None
        assert (sighting.chaser, sighting.sim_time_ns) == (image.chaser, image.sim_time_ns)


def test_shots_hold_the_latest_images(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 16, chasers=2)
    found = list(shots(log, 2, 0.25))
    assert [time_s for time_s, _ in found] == [0.0, 0.25, 0.5, 0.75, 1.0]
    for time_s, latest in found:
        assert set(latest) == {0, 1}
        for image, _ in latest.values():
            assert 0.0 <= time_s - image.sim_time_ns / 1e9 < 1 / 15 + 1e-6


def test_image_columns_fit_the_frame() -> None:
    for number in range(1, 17):
        columns, width = columns_for(number, 16 / 9, 480, 720)
        rows = -(-number // columns)
        assert columns * width <= 480
        assert rows * width * 9 / 16 <= 720


@pytest.mark.parametrize("model", ["paper", "servicer"])
@pytest.mark.parametrize(
    ("azimuth", "elevation", "face"),
    [(0, 0, 0), (180, 0, 1), (90, 0, 2), (-90, 0, 3), (0, 90, 4), (0, -90, 5)],
)
def test_drawn_target_shows_its_markers(
    model: str, azimuth: float, elevation: float, face: int
) -> None:
    """Drawn face-on, a face shows exactly the markers on it, neither mirrored nor rotated."""
    wanted = target_model(model)
    view = Viewpoint(np.zeros(3), 1.2, np.radians(azimuth), np.radians(elevation), 1200, 1200)
    pose = (np.zeros(3), rotations.IDENTITY)
    flown = scenario(target={"model": model}, camera={"sun_direction": view.axes()[2].tolist()})
    found = BodyRenderer(flown, (), view).render(view, pose, {})
    image = np.where(found.covered[:, :, None], found.bgr, np.uint8(128))
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, wanted.dictionary))
    corners, ids, _ = cv2.aruco.ArucoDetector(table).detectMarkers(image)
    normal = view.axes()[2]
    there = {k.id for k in wanted.markers if k.normal_trf() @ normal > 0.99}
    assert ids is not None
    assert set(np.ravel(ids).tolist()) == there
    for marker_id, quad in zip(np.ravel(ids).tolist(), corners, strict=True):
        marker = wanted.marker(int(marker_id))
        assert marker is not None
        expected, _ = view.project(marker.corners_trf_m())
        np.testing.assert_allclose(np.reshape(quad, (4, 2)), expected, atol=2.0)


def test_a_satellite_is_drawn_as_its_mesh() -> None:
    """With its panels beyond the body, and with its radiator before the wall that bears it."""
    flown = scenario(
        target={"model": "geo_servicer"},
        perception={"name": "model"},
        chaser={"mesh": "chaser_body"},
    )
    corners = np.concatenate([part.vertices_m for part, _ in target_body(flown).parts])
    np.testing.assert_allclose(
        [corners[:, 1].min(), corners[:, 1].max()], [-0.6387, 0.6393], atol=1e-3
    )
    view = Viewpoint(np.zeros(3), 2.6, np.radians(-70.0), np.radians(35.0), 480, 400)
    pose = (np.zeros(3), rotations.IDENTITY)
    image = BodyRenderer(flown, (), view).render(view, pose, {}).bgr.astype(int)
    radiator = next(p for p in satellite("geo_servicer").parts if p.name == "radiator_south")
    px, _ = view.project(radiator.vertices_m.mean(axis=0) - np.array([0.09, 0.002, 0.05]))
    x, y = np.round(px).astype(int)
    paint = image[y, x]
    assert np.ptp(paint) < 12, paint  # white paint; foil is golden
    foil = view.project(np.array([-0.19, -0.161, -0.14]))[0]
    x, y = np.round(foil).astype(int)
    assert image[y, x, 2] > 1.4 * image[y, x, 0]


def test_external_view_shows_plumes_and_the_simulated_stars(tmp_path: Path) -> None:
    flight = load_flight(made_log(tmp_path / "a.mcap", 5))
    flight.scenario = load_scenario(find_scenario("docking-contact"))
    flight.references = {}
    thrusters = len(flight.scenario.chaser.thrusters)
    views = []
    for duty in (np.zeros((1, thrusters)), np.ones((1, thrusters))):
        history = ActuatorHistory(np.array([0.0, 1.0]), np.zeros((1, 3)), np.zeros((1, 3)), duty)
        film = Film(Path(), flight, {0: history}, (640, 480), (0.0, 1.0), Verdict(True))
        views.append(film.draw(3))
    idle, firing = (view.astype(int) for view in views)
    brighter = (firing - idle).min(axis=2) > 20
    assert np.count_nonzero(brighter) > 50
    # Stars: single bright pixels far from the bodies, which are in the middle.
    assert np.count_nonzero(idle[60:440, 460:].min(axis=2) > 40) > 0


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("demo", (640, 360)),
        ("four-chaser-capture", (1280, 720)),
        ("four-chaser-capture", (320, 180)),
    ],
)
def test_labels_do_not_overlap_the_insets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, size: tuple[int, int]
) -> None:
    flight = load_flight(made_log(tmp_path / "a.mcap", 5))
    flight.scenario = load_scenario(find_scenario(name))
    flight.references = {0: ReferenceHistory(
        np.zeros(0), np.zeros((0, 3)), [(0.0, "approach")], np.zeros((0, 2))
    )}  # fmt: skip
    film = Film(Path(), flight, {}, size, (0.0, 0.3), Verdict(True))
    insets = [*film.layout.cameras, film.layout.close_up]
    for k, one in enumerate(insets):
        assert one.x + one.width <= size[0]
        assert one.y + one.height <= size[1]
        for other in insets[k + 1 :]:
            apart_x = one.x + one.width <= other.x or other.x + other.width <= one.x
            apart_y = one.y + one.height <= other.y or other.y + other.height <= one.y
            assert apart_x or apart_y
    film.draw(1)  # paints the chasers' numbers, too
    labels: list[tuple[int, int]] = []

    def put(
        image: Any, text: str, place: tuple[int, int], font: int, scale: float, *_: Any
    ) -> None:
        if image.shape[:2] == size[::-1]:
            labels.append((place[0] + cv2.getTextSize(text, font, scale, 2)[0][0], place[1]))

    monkeypatch.setattr("chaserdock.analysis.video.cv2.putText", put)
    film.draw(2)
    assert labels
    assert max(right for right, _ in labels) <= film.layout.close_up.x
    assert max(bottom for _, bottom in labels) <= size[1]


def test_description_is_written_in_full_within_the_width() -> None:
    text = "Four chasers hold around the tumbling target; 0 and 3 dock from 60 s on."
    lines = wrapped(text, 300, 0.5)
    assert len(lines) > 1
    assert " ".join(lines) == text
    for line in lines:
        assert cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] <= 300
    assert wrapped(text, 5, 0.5) == text.split()


def test_video_is_playable(short_flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    number = write_video(short_flight, out, speed=2.0, fps=10, width_px=640, height_px=360)
    with av.open(str(out)) as container:
        stream: Any = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.average_rate) == (640, 360, 10)
        images = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    assert len(images) == number == 31 + 40  # 6 s at double speed, both ends; 4 s of verdict
    assert np.mean(np.abs(images[0].astype(float) - images[30])) > 0.3  # something moves
    assert np.mean(np.abs(images[31].astype(float) - images[-1])) < 0.5


def test_video_of_an_interval(tmp_path: Path) -> None:
    """Frames cover the interval; an empty interval or one after the end raises an error."""
    log = made_log(tmp_path / "a.mcap", 8)
    flight = load_flight(log)
    every = [time_s for time_s, _ in film_of(log, flight, 1.0, 15, 320, 180).frames()]
    window = (every[2], every[5])
    part = [time_s for time_s, _ in film_of(log, flight, 1.0, 15, 320, 180, window).frames()]
    assert part == pytest.approx(every[2:6])  # without the last card
    assert len(every) == 8 + 60
    with pytest.raises(ChaserdockError, match="no length"):
        write_video(log, tmp_path / "a.webp", part_s=(2.0, 2.0))
    with pytest.raises(LogError, match="no image after 100 s"):
        write_video(log, tmp_path / "a.webp", part_s=(100.0, 200.0))
    assert not (tmp_path / "a.webp").exists()


def test_video_as_webp_and_gif(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 8)
    for name, begins in (("a.webp", b"RIFF"), ("a.gif", b"GIF89a")):
        assert write_video(log, tmp_path / name, width_px=320, height_px=180) == 8 + 60
        assert (tmp_path / name).read_bytes().startswith(begins)


@pytest.mark.parametrize(
    ("name", "size", "fault"),
    [("a.avi", (320, 180), "must end in"), ("a.mp4", (321, 180), "must be even")],
)
def test_invalid_video_format_is_rejected(
    tmp_path: Path, name: str, size: tuple[int, int], fault: str
) -> None:
    log = made_log(tmp_path / "a.mcap", 2)
    with pytest.raises(ChaserdockError, match=fault):
        write_video(log, tmp_path / name, width_px=size[0], height_px=size[1])
    assert not (tmp_path / name).exists()


def test_video_without_images_is_rejected(tmp_path: Path) -> None:
    log = made_log(tmp_path / "a.mcap", 0)
    with pytest.raises(LogError, match="nothing to film"):
        write_video(log, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


def test_report_command_prints_a_one_line_error(tmp_path: Path) -> None:
    status, said = finished("report", str(tmp_path))
    assert (status, "holds no log" in said, "Traceback" in said) == (2, True, False)


def test_missing_log_is_named(tmp_path: Path) -> None:
    for make in (report_of_path, figures_of_path, video_of_path):
        with pytest.raises(ChaserdockError, match="none: cannot be read: No such file"):
            make(tmp_path / "none", tmp_path)


def report_of_path(log: Path, out: Path) -> None:
    write_report(log, out / "a.html")


def figures_of_path(log: Path, out: Path) -> None:
    write_figures(log, out, "svg")


def video_of_path(log: Path, out: Path) -> None:
    write_video(log, out / "a.mp4")
