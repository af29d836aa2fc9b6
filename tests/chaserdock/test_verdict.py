# SPDX-License-Identifier: Apache-2.0
"""One verdict in every place that shows one: with criteria that were not judged, the end of the
flight, and estimates whose errors do not fit their covariance.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.codec import encode
from chaserdock_protocol.recording.log import LogError, LogWriter
from flight_cases import scenario
from typer.testing import CliRunner

from chaserdock.analysis import video
from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.report import report_of
from chaserdock.analysis.summary import summarize, summary_of, text_of
from chaserdock.api import RunResult
from chaserdock.cli.main import app
from chaserdock.criterion import COLUMNS
from chaserdock.experiments.campaign_report import sections
from chaserdock.experiments.page import html, markdown
from chaserdock.experiments.plan import ExperimentPlan, PlannedFlight
from chaserdock.experiments.results import rows_of
from chaserdock.experiments.worker import ExperimentProgress, FlightOutcome
from chaserdock.launch import launcher
from chaserdock.summary import Summary
from chaserdock.verdict import Verdict, estimate_doubts, verdict_of
from chaserdock.viewer import text as viewer_text
from chaserdock.viewer.logged import LoggedMission
from chaserdock.viewer.player import Judgement

TICKS, TICK_NS = 16, 66_666_667
NOT_JUDGED = "the flight ends at 1 s, its approach is at 60 s"
DOUBT = "target estimate: mean NEES 100 of 6, outside 3 to 12"
ENDED = "ended: completed at 1.00 s"
HEADLINE = "success, but 1 criterion not judged and NEES out of range"


def made_log(path: Path) -> Path:
    """A log of a second at rest that meets what can be judged; the estimate is 10 sigmas off."""
    mission = scenario(
        duration_s=1.0,
        settling_s=0.2,
        chasers=[{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
        timeline=[{"at_s": 60.0, "command": "approach", "chasers": [0]}],
        success={"docked": [0]},
        camera={"width_px": 96, "height_px": 64},
    )
    writer = LogWriter(path)
    writer.describe(mission.model_dump_json(), {"mode": "lockstep", "run_id": "r"})

    def put(topic: topics.Topic, place: Any, message: Any) -> None:
        sent_ns = 10**18 + message.sim_time_ns
        writer.write(topic.key_of(place), m.encoding_of(type(message)), encode(message), sent_ns)

    covariance = [0.0] * 144
    covariance[:: 12 + 1] = [1e-6] * 12
    for k in range(TICKS):
        head: dict[str, Any] = {"seq": k, "tick": k, "sim_time_ns": k * TICK_NS}
        rest: dict[str, Any] = {
            "velocity_m_s": (0, 0, 0),
            "q_wxyz": (1, 0, 0, 0),
            "omega_rad_s": (0, 0, 0),
        }
        put(topics.TICK, None, m.Tick(**head, images=True, chasers=(0,)))
        for name, x in (("target", 0.0), ("chaser/0", -1.0)):
            body = m.BodyTruth(**head, **rest, body=name, position_m=(x, 0.0, 0.0))
            put(topics.TRUTH_BODY, name, body)
        put(topics.TRUTH_WORLD, None, m.WorldTruth(**head, contacts=(), saturated=()))
        image = m.Image(
            **head, chaser=0, width_px=96, height_px=64, encoding="mono8", data=bytes(96 * 64)
        )
        put(topics.IMAGE, 0, image)
        known = m.TargetEstimate(
            **head,
            **rest,
            position_m=(0.01, 0.0, 0.0),
            covariance=tuple(covariance),
            status="tracking",
            accepted=(0,),
            rejected=(),
        )
        put(topics.TARGET, None, known)
    end = m.MissionEnd(seq=0, tick=15, sim_time_ns=15 * TICK_NS, reason="completed", complete=True)
    put(topics.END, None, end)
    writer.close()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_log(tmp_path_factory.mktemp("verdict") / "mission.mcap")


@pytest.mark.parametrize(
    ("verdict", "level", "headline"),
    [
        (Verdict(True), "good", "success"),
        (Verdict(True, not_judged=("a", "b")), "partial", "success, but 2 criteria not judged"),
        (Verdict(True, doubts=("a",)), "partial", "success, but NEES out of range"),
        (Verdict(False, not_met=("a",), not_judged=("b",)), "bad", "FAILED"),
    ],
)
def test_only_a_success_without_remarks_is_good(
    verdict: Verdict, level: str, headline: str
) -> None:
    assert (verdict.level, verdict.headline) == (level, headline)
    assert f'class="verdict {level}"' in verdict.badge()


@pytest.mark.parametrize(
    ("nees", "doubtful"), [(2.9, True), (3.0, False), (12.0, False), (40.0, True), (None, False)]
)
def test_nees_outside_its_band_is_doubtful_for_target_and_chasers(
    nees: float | None, doubtful: bool
) -> None:
    good = {"nees_mean": 6.0}
    target = {"target_estimate": {"nees_mean": nees}, "chasers": {"0": {"relative_estimate": good}}}
    chaser = {"target_estimate": good, "chasers": {"0": {"relative_estimate": {"nees_mean": nees}}}}
    assert len(estimate_doubts(target)) == len(estimate_doubts(chaser)) == doubtful
    assert all(line.startswith("chaser 0,") for line in estimate_doubts(chaser))


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("chaserdock.analysis.report.draw_figures", lambda *_: ())


def said(words: str) -> list[str]:
    """What of the verdict on the made log a text does not say."""
    line = " ".join(words.split())
    return [part for part in (HEADLINE, NOT_JUDGED, DOUBT, ENDED) if part not in line]


def test_terminal_and_judge_say_all_of_the_verdict(log: Path) -> None:
    assert said(text_of(summarize(log))) == []
    judged = CliRunner().invoke(app, ["judge", str(log)])
    assert (judged.exit_code, said(judged.output)) == (0, [])
    assert max(map(len, judged.output.splitlines())) <= COLUMNS
    values = json.loads(CliRunner().invoke(app, ["judge", str(log), "--json"]).output)
    assert verdict_of(values).lines() == verdict_of(summarize(log)).lines()


@pytest.mark.usefixtures("no_figures")
def test_report_says_all_of_the_verdict(log: Path) -> None:
    page = report_of(log)
    assert said(page[: page.index("<h2>")]) == []
    assert 'class="verdict partial"' in page


def test_film_says_all_of_the_verdict(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []

    draw = video.cv2.putText

    def put(image: Any, words: str, *more: Any) -> Any:
        written.append(words)
        return draw(image, words, *more)

    monkeypatch.setattr(video.cv2, "putText", put)
    for _ in video.film_of(log, load_flight(log), 3.0, 15, 1280, 360).frames():
        pass
    assert said(" ".join(written)) == []


def test_viewer_says_all_of_the_verdict_of_a_log(log: Path) -> None:
    mission = LoggedMission(log)
    verdict = Judgement(log).wait()
    head = viewer_text.head(mission.scenario, mission.at(1.0), "log", None, verdict)
    assert said(f"{head}\n{viewer_text.criteria(verdict)}") == []
    live = viewer_text.head(mission.scenario, mission.at(1.1), "lockstep", 1.0)
    assert "the verdict needs the log" in live


def test_viewer_says_why_a_log_cannot_be_judged(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(_: Any) -> Any:
        raise LogError("damaged at byte 7")

    monkeypatch.setattr("chaserdock.viewer.player.load_flight", damaged)
    verdict = Judgement(log).wait()
    assert verdict is not None
    assert "damaged at byte 7" in verdict.not_met[0]


def test_notebook_shows_all_of_the_verdict(log: Path) -> None:
    summary = Summary.from_dict(summarize(log))
    result = RunResult(summary, log.parent)
    for shown in (repr(summary), repr(result), summary._repr_html_(), result._repr_html_()):
        assert said(shown) == []
    assert str(log.parent) in repr(result)


def test_campaign_says_all_of_the_verdict(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = PlannedFlight(name="a", label="run 0", scenario="single", overrides=(), seed=0)
    plan = ExperimentPlan("p", (flight,), ())
    outcome = FlightOutcome("a", 0, summarize(log), "")
    rows = rows_of(plan, {"a": outcome})
    page = sections(plan, rows, {"a": outcome}, log.parent, "chaserdock campaign c.toml")
    for words in (markdown("p", page), html("p", page)):
        assert "1 not judged in full, 1 with a NEES out of range" in words
        for part in ("success.docked, chaser #", "mean NEES # of #", "completed at # s"):
            assert part in words
    ExperimentProgress()(1, 1, flight, outcome)
    assert HEADLINE in capsys.readouterr().out


@pytest.mark.usefixtures("no_figures")
def test_failure_that_only_the_launcher_knows_is_in_every_verdict(tmp_path: Path) -> None:
    """The recorder crashed after the end: nothing in the log says so."""
    log = made_log(tmp_path / "mission.mcap")
    reporter = launcher.ProgressReporter(load_flight(log).scenario, launcher.Show.none)
    launcher.judge(launcher.Fleet(), tmp_path, "recorder: crashed", reporter)
    assert summarize(log)["failures"] == summarize(tmp_path)["failures"] == ["recorder: crashed"]
    assert "recorder: crashed" in report_of(tmp_path)
    verdict = Judgement(tmp_path).wait()
    assert verdict is not None
    assert verdict.not_met == ("recorder: crashed",)
    # A summary of another flight does not count.
    file = tmp_path / "summary.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"digest": "other"}))
    assert summarize(log)["success"]
    file.write_text("{")
    with pytest.raises(LogError, match=r"summary\.json: not readable"):
        summarize(log)


def test_log_that_ends_before_the_mission_does_not_say_that_it_completed(tmp_path: Path) -> None:
    log = made_log(tmp_path / "mission.mcap")
    flight = load_flight(log)
    assert flight.end is not None
    flight.end = None
    assert "the log ends before the mission does" in summary_of(flight)["ended"]
