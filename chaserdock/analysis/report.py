# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML report of a recorded flight: result, tables, 3-D replay, figures, events,
scenario, versions.

The page opens from a file without a network; its Content-Security-Policy forbids requests. It names
the parts that an incomplete log lacks.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import Any

from chaserdock_protocol.output_files import write_atomically

from chaserdock.criterion import html_of_all, quantity
from chaserdock.html_page import PAGE_FILES, html_page, table
from chaserdock.verdict import verdict_of

from .charts import ChartData
from .criteria import capture_state
from .figures import FIGURES, draw_figures
from .flight import RecordedFlight, load_flight
from .mass_properties import PRIOR_ONLY, property_rows, true_values
from .motion import TARGET
from .plots import decimation, to_inline_svg
from .replay_scene import replay_data, small_images
from .summary import summary_of_run
from .time_series import load_traces

_DASH = "–"  # noqa: RUF001


ReportStep = Callable[[str, int, int], None]
"""Receives what is done next, the number of steps that are done, and that of all."""
_READ = ("reading the log", "reading time series")


def write_report(
    log: Path, out: Path | None = None, progress: ReportStep = lambda *_: None
) -> Path:
    """Write the report of a log (or run folder), by default ``report.html`` beside the log; return
    its path. ``progress``: called before each step.

    Raise LogError for an unreadable log and ChaserdockError for a path that is not writable.
    """
    out = out or (log if log.is_dir() else log.parent) / "report.html"
    text = report_of(log, progress)
    write_atomically(out, text)
    return out


def report_of(log: Path, progress: ReportStep = lambda *_: None) -> str:
    """Return the report as HTML. Raise LogError for an unreadable log."""
    steps = [*_READ, *(f"figure: {kind.title}" for kind in FIGURES), "replay and images"]

    def begin(step: int) -> None:
        progress(steps[step], step, len(steps))

    begin(0)
    flight = load_flight(log)
    result = summary_of_run(flight, log)
    begin(1)
    every = decimation(flight.ticks)
    traces = load_traces(log, flight.scenario, every)

    missing: list[str] = []
    figures, charts = [], ChartData()
    begin(len(_READ))
    for number, (kind, figure) in enumerate(draw_figures(flight, traces), len(_READ) + 1):
        begin(number)
        if isinstance(figure, str):
            missing.append(f"{kind.title}: {figure}.")
            continue
        svg = to_inline_svg(figure, kind.name, kind.title)
        charts.add(kind.name, figure)
        figures.append(
            f'<h3 id="figure-{kind.name}">{escape(kind.title)}</h3>\n<figure '
            f'id="plot-{kind.name}"><figcaption>{escape(kind.caption)}</figcaption>\n<div '
            f'class="wide"><div class="still">{svg}</div></div>'
            '<div class="charts" hidden></div></figure>'
        )

    replay, script = "", _chart_script(charts) if charts.figures else ""
    if flight.shown:
        data = replay_data(flight, traces, small_images(log, flight))
        replay = _replay(data)
        script += _script("replay-data", data, _page_file("replay.js"))
    else:
        missing.insert(
            0,
            "3-D replay: the log holds neither ground truth nor a reference of target and chaser.",
        )

    body = [
        _head(flight, result),
        _outcome(result),
        _chasers(flight, result),
        _numbers(flight, result),
        _identified(flight),
        replay,
        '<h2 id="figures">Figures</h2>',
        f'<p class="faint">Long flight: figures show one of {every} ticks; tables use all.</p>'
        if every > 1
        else "",
        *figures,
        _missing(missing),
        _events(result, bool(replay)),
        _details(flight, result),
    ]
    return html_page(f"{flight.scenario.name} {_DASH} chaserdock", body, script)


def _page_file(name: str) -> str:
    return (PAGE_FILES / name).read_text(encoding="utf-8")


def _script(name: str, data: Any, code: str) -> str:
    """Return data of this id, and the code that reads it, as elements of the page."""
    # "</" would end the script element.
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    stored = f'<script type="application/json" id="{name}">{text}</script>'
    return f"{stored}\n<script>\n{code}</script>\n"


def _chart_script(charts: ChartData) -> str:
    """Return the charts with their library, whose licence asks for its text in every copy."""
    library = _page_file("uPlot.iife.min.js").partition("\n")[2]  # without the address of its site
    licence, style = _page_file("uPlot.LICENSE.txt"), _page_file("uPlot.min.css")
    code = f"/*! uPlot 1.6.32\n{licence}*/\n{library}\n{_page_file('charts.js')}"
    data = {"arrays": charts.pool.arrays, "figures": charts.figures}
    return f"<style>{style}</style>\n{_script('chart-data', data, code)}"


def _number(value: int | None) -> str:
    return _DASH if value is None else str(value)


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def _rms(errors: dict[str, Any]) -> str:
    """Return the RMS of position and orientation errors."""
    square_m2, square_rad2 = errors["position_mse_m2"], errors["orientation_mse_rad2"]
    if square_m2 is None or square_rad2 is None:
        return _DASH
    position, angle = math.sqrt(square_m2), math.sqrt(square_rad2)
    return f"{quantity(position, 'mm', 1e3)}, {quantity(angle, '°', math.degrees(1.0))}"


def _head(flight: RecordedFlight, result: dict[str, Any]) -> str:
    s = flight.scenario
    verdict = verdict_of(result).badge()
    where = [
        ("figures", "Figures"),
        ("events", "Events"),
        ("scenario", "Scenario"),
        ("versions", "Versions"),
    ]
    if flight.shown:
        where.insert(0, ("replay-section", "Replay"))
    links = "".join(f'<a href="#{anchor}">{name}</a>' for anchor, name in where)
    mode = {"lockstep": "lock-step", "realtime": "real time"}.get(result["mode"]) or "unknown mode"
    wall = f" in {result['wall_time_s']:.1f} s" if result["wall_time_s"] else ""
    return (
        f"<h1>{escape(s.name)}</h1><p>{escape(s.description)}</p>\n<p>{verdict} "
        f'<span class="faint">{result["sim_time_s"]:.1f} s of {s.duration_s:g} s flown{wall}, '
        f"{escape(mode)}; {_count(len(s.chasers), 'chaser')}; seed "
        f"{s.seed}; "
        f"digest {escape(result['digest'][:16])}</span></p>\n"
        f"<p>Judged against {escape(result['judged_against'])}.</p>\n<nav>{links}</nav>"
    )


def _outcome(result: dict[str, Any]) -> str:
    return verdict_of(result).html(table=True)


def _chasers(flight: RecordedFlight, result: dict[str, Any]) -> str:
    if not result["chasers"]:
        return "<h2>Chasers</h2><p>The log holds no chaser.</p>"
    mass_kg = flight.scenario.chaser.mass_kg
    at_distance = any("capture" not in c for c in result["chasers"].values())
    relative = any("relative_estimate" in c for c in result["chasers"].values())
    fuel = any(c["propellant_kg"] > 0.0 for c in result["chasers"].values())
    estimated = any("estimated_tracking" in c for c in result["chasers"].values())
    innovations = any("innovations" in c for c in result["chasers"].values())
    rows = [
        (
            f"chaser {i}",
            _rms(c["steady"]),
            _rms(c),
            *([_estimated(c)] if estimated else []),
            *([_relative(c)] if relative else []),
            *([_innovations(c)] if innovations else []),
            *([_docked(c)] if at_distance else []),
            quantity(c["min_distance_target_m"], "m"),
            f"{quantity(c['impulse_N_s'], 'N s')}; {quantity(c['impulse_N_s'] / mass_kg, 'm/s')}",
            *([quantity(c["propellant_kg"], "g", 1e3)] if fuel else []),
        )
        for i, c in result["chasers"].items()
    ]
    s = flight.scenario
    head = (
        "",
        "steady RMS",
        "RMS, whole flight",
        *(["steady RMS as estimated in flight; sightings rejected"] if estimated else []),
        *(["estimated pose relative to the target, RMS"] if relative else []),
        *(["NIS per degree of freedom; above the 95 % band"] if innovations else []),
        *(["docking pose since"] if at_distance else []),
        "minimum distance to target",
        "impulse; velocity change",
        *(["propellant"] if fuel else []),
    )
    until = s.steady_until_s or s.duration_s
    docked = (
        " Docking pose since: within the tolerances of [approach] from then to the end. The phase "
        f"docked begins {s.approach.docked_time_s:g} s later: the controller waits that long."
        if at_distance and s.success.docked
        else ""
    )
    return (
        "<h2>Chasers</h2>"
        + table(head, rows)
        + '<p class="faint">Errors relative to the reference pose on the true target. '
        + f"Steady state: {s.settling_s:g} s to {until:g} s.{docked}</p>"
        + _captures(result)
        + _rendezvous(result)
    )


def _relative(c: dict[str, Any]) -> str:
    """Return the errors of the estimated pose of a chaser relative to the target."""
    e = c.get("relative_estimate")
    if e is None:
        return _DASH
    position, angle = e["position_rms_m"], e["orientation_rms_rad"]
    return f"{quantity(position, 'mm', 1e3)}, {quantity(angle, '°', math.degrees(1.0))}"


def _innovations(c: dict[str, Any]) -> str:
    """Return the innovations of the sightings of a chaser: mean of the used, share above."""
    found = c.get("innovations")
    if found is None:
        return _DASH
    return f"{quantity(found['mean_per_freedom'], '')}; {quantity(found['above_share'], '%', 1e2)}"


def _estimated(c: dict[str, Any]) -> str:
    """Return the tracking errors by the flight's own estimates, and its rejected sightings."""
    e, use = c["estimated_tracking"], c["sightings"]
    position = quantity(e["position_rms_m"], "mm", 1e3)
    angle = quantity(e["orientation_rms_rad"], "°", math.degrees(1.0))
    return f"{position}, {angle}; {use['rejected']} of {use['used'] + use['rejected']}"


def _docked(c: dict[str, Any]) -> str:
    if "capture" in c:
        return _DASH  # a chaser with a port does not dock at a distance
    if c["docked"] is None:
        return _DASH
    return f"{c['dock_time_s']:.2f} s" if c["docked"] else "no"


def _captures(result: dict[str, Any]) -> str:
    """Return a table of the captures, with the values at the touch that closed the latch."""
    degree = math.degrees(1.0)
    rows = [
        (
            f"chaser {i}",
            capture_state(k),
            quantity(k["latch_time_s"], "s", digits=4),
            quantity(k["contact_lateral_m"], "mm", 1e3),
            quantity(k["contact_angle_rad"], "°", degree),
            quantity(k["contact_closing_m_s"], "mm/s", 1e3),
            quantity(k["contact_lateral_speed_m_s"], "mm/s", 1e3),
            str(k["probe_touches"]),
        )
        for i, c in result["chasers"].items()
        if (k := c.get("capture")) is not None
    ]
    head = (
        "",
        "at the end",
        "latched at",
        "lateral offset",
        "misalignment",
        "closing speed",
        "lateral speed",
        "touches of the probe",
    )
    if not rows:
        return ""
    return (
        f"<h2>Capture</h2>{table(head, rows)}"
        '<p class="faint">Offset, misalignment and speeds at the touch that closed the latch. '
        "Verified: the latch held in the "
        "pull test.</p>"
    )


def _rendezvous(result: dict[str, Any]) -> str:
    """Return a table of the quantities that the criteria of a published task judge."""
    rows = [
        (
            f"chaser {i}",
            quantity(k["speed_margin_m_s"], "mm/s", 1e3),
            quantity(k["cone_angle_rad"], "°", math.degrees(1.0)),
            quantity(k["arrived_s"], "s", digits=5),
            quantity(k["arrived_speed_m_s"], "mm/s", 1e3),
            quantity(k["abort_s"], "s", digits=5),
            quantity(k["abort_clear_m"], "m"),
        )
        for i, c in result["chasers"].items()
        if (k := c.get("rendezvous")) is not None
    ]
    head = (
        "",
        "least margin to the speed limit",
        "largest angle from the cone's axis",
        "arrived at",
        "speed on arrival",
        "aborted at",
        "clear of the target since",
    )
    return f"<h2>Rendezvous</h2>{table(head, rows)}" if rows else ""


def _numbers(flight: RecordedFlight, result: dict[str, Any]) -> str:
    e, degree = result["target_estimate"], math.degrees(1.0)
    estimate = [
        (
            "position",
            quantity(e["position_rms_m"], "mm", 1e3),
            quantity(e["max_position_error_m"], "mm", 1e3),
        ),
        (
            "orientation",
            quantity(e["orientation_rms_rad"], "°", degree),
            quantity(e["max_orientation_error_rad"], "°", degree),
        ),
        ("velocity", quantity(e["velocity_rms_m_s"], "mm/s", 1e3), ""),
        ("rate", quantity(e["omega_rms_rad_s"], "°/s", degree), ""),
    ]
    latency, solver = result["latency_s"], result["solver"]
    timing = [
        (f"solve time ({solver['name']}), median", quantity(solver["solve_s"]["p50"], "ms", 1e3)),
        ("solve time, 95th percentile", quantity(solver["solve_s"]["p95"], "ms", 1e3)),
        ("exposure to command, median", quantity(latency["p50"], "ms", 1e3)),
        ("exposure to command, 99th percentile", quantity(latency["p99"], "ms", 1e3)),
    ]
    against = flight.motion.describe() if TARGET in flight.motion else "nothing: no figures"
    safety = [
        ("minimum distance between chasers", quantity(result["min_distance_chasers_m"], "m")),
        ("collisions", _number(result["collisions"])),
        ("mean NEES of the estimate (6 expected)", quantity(e["nees_mean"], "")),
        ("failed solves", str(solver["failures"])),
        *(timing if result["wall_time_s"] else ()),  # virtual time: no computation takes any
        ("late commands", _number(result["late_commands"])),
        ("messages lost", str(sum(m["lost"] for m in result["messages"].values()))),
    ]
    return (
        '<div class="pair"><section><h2>Target '
        f"estimate</h2>{table(('', 'RMS', 'largest error'), estimate)}"
        f'<p class="faint">Fused estimate against {escape(against)}, at the time '
        f"of exposure, from {flight.scenario.settling_s:g} s on.</p></section>"
        f"<section><h2>Safety and timing</h2>{table(('', ''), safety)}</section></div>"
    )


def _identified(flight: RecordedFlight) -> str:
    """Return a table of the identified mass properties at the end, beside the stated and the true
    ones.
    """
    if flight.identified is None:
        return ""
    drawn = next((b for b in flight.drawn if b.body == "target"), None)
    last = flight.identified.last
    rows = property_rows(
        last, flight.scenario, None if drawn is None else true_values(drawn), _DASH
    )
    chasers = ", ".join(map(str, last.chasers))
    stack = f"stack with chasers {chasers}" if chasers else "stack"
    head = ("", "target, identified", "stated", "true", "error", stack)
    cells = [(r.name, r.target, r.stated, r.true, r.off, r.stack) for r in rows]
    return (
        f'<h2 id="identified">Identified mass properties</h2>{table(head, cells)}'
        f'<p class="faint">At {last.sim_time_ns / 1e9:.1f} s, with one standard deviation. Centre '
        "of mass and inertia about it in "
        "TRF axes. Stated: what the controllers know before the flight. "
        f"{PRIOR_ONLY.strip('()').capitalize()}: the flight has taught nothing about it.</p>"
    )


def _drawn(flight: RecordedFlight) -> str:
    """Return a table of the true bodies and sensors, beside the nominal values that the flight
    software has.
    """
    stated = {"target": flight.scenario.target.mass_kg} | {
        f"chaser/{i}": flight.scenario.chaser.mass_kg for i in range(len(flight.scenario.chasers))
    }
    columns = [
        (
            f"{b.mass_kg:.4g} ({stated.get(b.body, math.nan):.4g})",
            _numbers_text(b.inertia_kg_m2[::4], 1.0),
            _numbers_text(b.centre_of_mass_m, 1e3),
            _numbers_text(b.force_N, 1e3),
            _numbers_text(b.torque_N_m, 1e3),
            _numbers_text(b.thrust_share, 100.0),
            _numbers_text(b.camera_turn_rad, 180.0 / math.pi),
            _numbers_text(b.camera_shift_m, 1e3),
            _numbers_text((b.camera_focal_share,), 100.0),
            _numbers_text(b.gyro_bias_rad_s, 180.0 / math.pi),
        )
        for b in flight.drawn
    ]
    quantities = (
        "mass, kg (stated)",
        "inertia xx, yy, zz, kg m²",
        "centre of mass, mm",
        "force, mN",
        "torque, mN m",
        "thrust, %",
        "camera turn, deg",
        "camera shift, mm",
        "focal length, %",
        "gyro bias, deg/s",
    )
    # One column per body: with one per quantity even a wide screen would cut the table off.
    rows = [row for row in zip(quantities, *columns, strict=True) if set(row[1:]) != {"0"}]
    head = ("", *(b.body for b in flight.drawn))
    return (
        '<details id="drawn"><summary>True bodies and sensors</summary>'
        f'{table(head, rows)}<p class="faint">What is 0 for all bodies is left out.</p></details>'
        if columns
        else ""
    )


def _numbers_text(values: Iterable[float], factor: float) -> str:
    numbers = [value * factor for value in values]
    return ", ".join(f"{number:.3g}" for number in numbers) if any(numbers) else "0"


def _replay(data: dict[str, Any]) -> str:
    end = data["times"][-1]
    cameras = list(data["images"]["chasers"])
    columns = 1 if len(cameras) <= 4 else 2
    width = 256 if len(cameras) <= 2 else 210 if len(cameras) == 3 else 190
    images = "".join(f'<img data-chaser="{i}" alt="image of chaser {i}">' for i in cameras)
    views = (
        f'<div id="replay-views" style="grid-template-columns: repeat({columns}, 1fr); width: '
        f'{width * columns}px">'
        f"{images}</div>"
    )
    rows = "".join(f'<tr id="replay-row-{c["id"]}"></tr>' for c in data["chasers"])
    speeds = "".join(
        f'<option value="{v}"{" selected" if v == 5 else ""}>{v} ×</option>'  # noqa: RUF001
        for v in (1, 2, 5, 10, 20)
    )
    return f"""<h2 id="replay-section">Replay</h2>
<div class="player">
<div class="stage"><canvas id="replay" tabindex="0" role="img"
aria-label="target and chasers in three dimensions"></canvas>{views}</div>
<div class="controls"><button id="replay-play" type="button">Play</button>
<input id="replay-time" type="range" min="0" max="{end}" step="0.05" value="0" aria-label="time">
<span id="replay-clock"></span>
<label>speed <select id="replay-speed">{speeds}</select></label>
<label><input id="replay-ride" type="checkbox"> target frame</label></div>
<div class="wide"><table>
<thead><tr><th></th><th>phase</th><th>distance to target</th>
<th>position error</th><th>image</th></tr></thead>
<tbody>{rows}</tbody></table></div>
<p class="faint">Drag to rotate, wheel to zoom; or arrow keys, + and −; space starts and stops. \
{data["motion"]}.
A camera frustum is bright while its image is used. Chasers have the colours of the figures.</p>
</div>"""  # noqa: RUF001


def _missing(missing: list[str]) -> str:
    if not missing:
        return ""
    items = "".join(f"<li>{escape(m)}</li>" for m in missing)
    return f'<h3 id="missing">Missing from this log</h3><ul class="faint">{items}</ul>'


def _events(result: dict[str, Any], seekable: bool) -> str:
    if not result["events"]:
        return '<h2 id="events">Events</h2><p>None recorded.</p>'
    rows = []
    for event in result["events"]:
        time_s = event["time_s"]
        label = f"{time_s:.2f} s"
        if seekable:
            shown = f'data-time="{time_s:.3f}" title="show in the replay"'
            label = f'<button type="button" {shown}>{label}</button>'
        rows.append(f'<tr><td>{label}</td><td class="text">{escape(event["what"])}</td></tr>')
    lines = f"<table><tbody>{''.join(rows)}</tbody></table>"
    return f'<h2 id="events">Events</h2><div class="wide">{lines}</div>'


def _details(flight: RecordedFlight, result: dict[str, Any]) -> str:
    scenario = json.dumps(flight.scenario.model_dump(mode="json"), indent=2, ensure_ascii=False)
    versions = [
        (k.removeprefix("version."), v)
        for k, v in sorted(flight.run.items())
        if k.startswith("version.")
    ]
    run = [(k, v) for k, v in sorted(flight.run.items()) if not k.startswith("version.")]
    messages = [(key, str(m["count"]), str(m["lost"])) for key, m in result["messages"].items()]
    refused = [(reason, str(count)) for reason, count in result["rejected"].items()]
    # The full digest: it identifies equal flights.
    run.append(("digest", result["digest"]))
    return (
        '<h2 id="scenario">Scenario and data</h2>'
        "<details><summary>Criteria of every chaser</summary>"
        f"{html_of_all(verdict_of(result).criteria)}</details>{_drawn(flight)}"
        f"<details><summary>Scenario as flown</summary><pre>{escape(scenario)}</pre></details>"
        f"<details><summary>Messages</summary>{table(('topic', 'in the log', 'lost'), messages)}"
        + (f"<h3>Rejected on receipt</h3>{table(('reason', 'count'), refused)}" if refused else "")
        + "</details>"
        "<details><summary>Summary as "
        f"JSON</summary><pre>{escape(json.dumps(result, indent=2))}</pre></details>"
        f'<h2 id="versions">Run and versions</h2>{table(("", ""), [*run, *versions], text=True)}'
    )
