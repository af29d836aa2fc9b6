# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the guides: ``python docs/make_images.py [NAME ...]`` (default: all).

Diagrams need nothing. Pictures of flights fly the scenarios that they show by ``chaserdock
simulate`` into ``--logs`` (default: runs/images), unless a log is there already. Other pictures are
made by commands that stand beside them, those of the camera by make_camera_images.py.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.chaser.assurance.barriers import Barrier
from chaserdock_agents.chaser.sighting import decode_image
from chaserdock_models import rotations
from chaserdock_models.thruster_bodies import BODIES
from chaserdock_protocol.messages import PX_STEP, FeatureTracks, Image
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.physics.simulation import TARGET, BodyState
from chaserdock_world.rendering.cameras import Cameras
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon

from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.analysis.mapping import rate_error
from chaserdock.analysis.plots import FAINT, GRID, INK, LIMIT, SERIES, colour, styled
from chaserdock.analysis.pose_errors import pose_error
from chaserdock.analysis.summary import tracking_errors
from chaserdock.envs import make

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
FAULTS = """extends = "{shipped}"
name = "docs-faults"
description = "fault-drill with a blind camera, odometry that lies and a link that is cut."
duration_s = 35.0
[success]
[[fault]]
kind = "camera_off"
at_s = 8.0
duration_s = 4.0
process = "chaser/0"
[[fault]]
kind = "odometry_lie"
at_s = 15.0
duration_s = 5.0
process = "chaser/1"
offset_m = [0.05, 0.0, 0.0]
[[fault]]
kind = "cut"
at_s = 23.0
duration_s = 6.0
process = "chaser/2"
peer = "controller"
"""

CAMPAIGN = """name = "docs-campaign"
scenario = "single"
seeds = 24
[set]
duration_s = 30.0
settling_s = 15.0
"perception.name" = "statistical"
"truth.preset" = "mismatch"
"success.steady_position_rms_m" = 0.0035
"""

LEAST_EPISODES = 200
"""Episodes of a batch from which on it is in the training curve: a mean of fewer is noise."""

logs = ROOT / "runs" / "images"


# -- diagrams --------------------------------------------------------------------------------------

FILLS = {"real": "#dcebf7", "simulated": "#fdebd8", "person": "#e9e4f3", "file": "#e6f2ec"}
"""Colours of boxes: real code, simulation, people and foreign programs, files."""


@dataclass(frozen=True)
class Box:
    """A box of a diagram with its middle in a grid of 1 x 1 cells, and its size in cells."""

    x: float
    y: float
    text: str
    kind: str = "real"
    width: float = 0.78
    height: float = 0.5
    font_pt: float = 9.0


def diagram(
    name: str,
    boxes: dict[str, Box],
    arrows: list[tuple[str, str, str] | tuple[str, str, str, float]],
    cell: tuple[float, float] = (1.75, 0.95),
    margin: float = 0.15,
) -> None:
    """Write boxes and labelled arrows as docs/images/NAME.svg.

    ``arrows``: from, to, label, and the curvature (0: straight); vertical where they reach a box
    that is wider than a cell. ``cell``: its size in inches. ``margin``: cells above and below.
    """
    left = min(b.x - b.width / 2 for b in boxes.values()) - 0.1
    right = max(b.x + b.width / 2 for b in boxes.values()) + 0.1
    low = min(b.y - b.height / 2 for b in boxes.values()) - margin
    high = max(b.y + b.height / 2 for b in boxes.values()) + margin
    size = ((right - left) * cell[0], (high - low) * cell[1])
    with styled(name):
        figure = Figure(figsize=size)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(left * cell[0], right * cell[0]), ylim=(low * cell[1], high * cell[1]))
        axes.axis("off")
        patches = {}
        for key, box in boxes.items():
            w, h = box.width * cell[0], box.height * cell[1]
            corner = (box.x * cell[0] - w / 2, box.y * cell[1] - h / 2)
            patches[key] = FancyBboxPatch(
                corner, w, h, boxstyle="round,pad=0,rounding_size=0.08",
                facecolor=FILLS[box.kind], edgecolor=FAINT, linewidth=0.8,
            )  # fmt: skip
            axes.add_patch(patches[key])
            axes.text(
                box.x * cell[0], box.y * cell[1], box.text,
                ha="center", va="center", fontsize=box.font_pt,
            )  # fmt: skip
        for begin, end, label, *bend in arrows:
            a, b = boxes[begin], boxes[end]
            x = float(np.clip(a.x, b.x - b.width / 2, b.x + b.width / 2)) if b.width > 1.5 else b.x
            start, stop = (a.x * cell[0], a.y * cell[1]), (x * cell[0], b.y * cell[1])
            curve = bend[0] if bend else 0.0
            arrow = FancyArrowPatch(
                start, stop, patchA=patches[begin], patchB=patches[end], shrinkA=2, shrinkB=2,
                connectionstyle=f"arc3,rad={curve}", arrowstyle="-|>", mutation_scale=10,
                color=INK, linewidth=0.9,
            )  # fmt: skip
            axes.add_patch(arrow)
            # The middle of the quadratic curve, halfway between the boxes' edges.
            dx, dy = stop[0] - start[0], stop[1] - start[1]
            middle = (
                (start[0] + stop[0]) / 2 + curve * dy / 2,
                (start[1] + stop[1]) / 2 - curve * dx / 2,
            )
            axes.text(
                *middle, label, ha="center", va="center", fontsize=7.5, color=INK,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            )  # fmt: skip
        figure.savefig(IMAGES / f"{name}.svg", facecolor="white", metadata={"Date": None})


def processes() -> None:
    diagram(
        "processes",
        {
            "world": Box(0, 1, "world\nbodies, cameras", "simulated"),
            "chaser": Box(1.7, 1, "chaser 0 … N\nperception, thrusters"),
            "controller": Box(3.4, 1, "controller\nestimation, NMPC"),
            "standby": Box(4.9, 1, "standby"),
            "operator": Box(3.4, 2, "operator, ROS 2", "person"),
            "recorder": Box(
                1.7, 0, "recorder (mission.mcap) and viewer: every message", "file", 4.2
            ),
        },
        [
            ("world", "chaser", "image, odometry", -0.2),
            ("chaser", "world", "thruster pulses", -0.2),
            ("chaser", "controller", "pose measurement", -0.2),
            ("controller", "chaser", "wrench, plan", -0.2),
            ("controller", "standby", "state"),
            ("operator", "controller", "command"),
            ("world", "recorder", ""),
            ("chaser", "recorder", ""),
            ("controller", "recorder", ""),
        ],
    )


def simulation() -> None:
    diagram(
        "simulation",
        {
            "seed": Box(0, 1, "seed", "file"),
            "case": Box(
                1.2, 1, "faults, network,\nclocks, truth,\ncommands", "simulated", 0.9, 0.75
            ),
            "flight": Box(2.5, 1, "flight in\nvirtual time"),
            "invariants": Box(3.9, 1, "invariants"),
            "counted": Box(3.9, 0, "counted: docked,\nsafe, unfinished", "file", 0.95),
            "shrink": Box(2.5, 0, "reduce\nthe scenario"),
            "file": Box(1.2, 0, "SCENARIO-\nseed-N.toml", "file", 0.9),
        },
        [
            ("seed", "case", ""),
            ("case", "flight", ""),
            ("flight", "invariants", "every tick"),
            ("invariants", "counted", "hold"),
            ("invariants", "shrink", "violated"),
            ("shrink", "file", ""),
            ("file", "flight", "fly again"),
        ],
    )


def spread() -> None:
    diagram(
        "spread",
        {
            "client": Box(0, 1, "simulate or\ncampaign"),
            "table": Box(0, 0, "results: a line or\na file each", "file", 0.95),
            "scheduler": Box(1.6, 1, "Dask scheduler\nof your cluster", "person", 0.9),
            "worker": Box(3.2, 1.5, "Dask worker\nof your cluster", "person", 0.85),
            "other": Box(3.2, 0.5, "Dask worker\nof your cluster", "person", 0.85),
            "flight": Box(4.8, 1.5, "a process per\nthread: a flight", "simulated", 0.9),
            "refused": Box(4.8, 0.5, "another version:\nrefused", "file", 0.9),
        },
        [
            ("client", "scheduler", "seeds", -0.2),
            ("scheduler", "client", "results", -0.2),
            ("client", "table", "as they come"),
            ("scheduler", "worker", ""),
            ("scheduler", "other", ""),
            ("worker", "flight", ""),
            ("other", "refused", ""),
        ],
    )


def redundancy() -> None:
    diagram(
        "redundancy",
        {
            "controller": Box(0, 1.7, "controller\nterm 5, then silent"),
            "chasers": Box(2, 0.85, "chasers\ngrant leases of\ntwo ticks", "real", 0.85, 0.75),
            "standby": Box(0, 0, "standby\nterm 6"),
            "world": Box(4, 0.85, "world", "simulated"),
        },
        [
            ("chasers", "controller", "lease, until it is silent", 0.16),
            ("controller", "chasers", "wrench", 0.16),
            ("chasers", "standby", "next lease", -0.16),
            ("standby", "chasers", "wrench", -0.16),
            ("controller", "standby", "state"),
            ("chasers", "world", "pulses", -0.15),
            ("world", "chasers", "who is connected", -0.15),
        ],
    )


def perception() -> None:
    diagram(
        "perception",
        {
            "prior": Box(0, 1, "prior pose", "file"),
            "light": Box(1.15, 1, "light"),
            "view": Box(2.3, 1, "synthetic\nview"),
            "points": Box(3.45, 1, "control\npoints"),
            "align": Box(4.6, 1, "alignment:\npose, modes"),
            "gate": Box(4.6, 0, "gate"),
            "sighting": Box(3.2, 0, "sighting", "file"),
            "starts": Box(1.15, 0, "twelve starts"),
            "acquire": Box(0, 0, "acquisition"),
        },
        [
            ("prior", "light", ""),
            ("light", "view", ""),
            ("view", "points", ""),
            ("points", "align", ""),
            ("align", "gate", ""),
            ("align", "light", "still turns", 0.17),
            ("gate", "sighting", "passed"),
            ("gate", "starts", "rejected again and again", -0.17),
            ("starts", "acquire", ""),
            ("acquire", "prior", ""),
            ("starts", "light", ""),
        ],
        (1.5, 1.05),
        0.4,
    )


def errors() -> None:
    diagram(
        "errors",
        {
            "seed": Box(0, 0.5, "seed", "file", 0.55),
            "navigation": Box(1.3, 1, "[navigation]\nsizes of sensor errors", "file", 1.0),
            "truth": Box(1.3, 0, "[truth]\ntrue plant", "file", 1.0),
            "world": Box(3, 0, "world", "simulated"),
            "flight": Box(3, 1, "flight software"),
            "report": Box(4.6, 0, "log, report", "file"),
        },
        [
            ("seed", "navigation", ""),
            ("seed", "truth", ""),
            ("navigation", "flight", "sizes only"),
            ("navigation", "world", "drawn errors"),
            ("truth", "world", "drawn bodies"),
            ("world", "flight", "odometry, images"),
            ("world", "report", "truth/drawn"),
        ],
    )


def hosts() -> None:
    diagram(
        "hosts",
        {
            "router": Box(2, 1, "router\naccess control", "real", 0.85),
            "world": Box(0, 2, "world", "simulated"),
            "recorder": Box(0, 1, "recorder", "file"),
            "mission": Box(0, 0, "mission: judge,\nreport", "file"),
            "c0": Box(4, 2, "chasers 0 … N"),
            "controller": Box(4, 1, "controller,\nstandby"),
            "operator": Box(4, 0, "operator", "person"),
            "viewer": Box(2, 0, "viewer: page on\nloopback only", "person", 0.85),
        },
        [
            ("world", "router", "TLS, a certificate each"),
            ("router", "recorder", ""),
            ("router", "mission", ""),
            ("c0", "router", "TLS"),
            ("controller", "router", "TLS"),
            ("operator", "router", "TLS"),
            ("router", "viewer", ""),
        ],
        (1.75, 0.8),
    )


def limits() -> None:
    diagram(
        "limits",
        {
            "bodies": Box(0, 0, "bodies, contact,\nvalves", "simulated", 0.85),
            "cameras": Box(0, 1, "camera images,\nodometry", "simulated", 0.85),
            "perception": Box(1.5, 1, "perception"),
            "estimation": Box(2.6, 1, "estimation"),
            "guidance": Box(3.7, 1, "guidance,\nNMPC"),
            "allocation": Box(3.7, 0, "thruster\nallocation"),
            "truth": Box(1.5, 0, "[truth]: mismatch,\noff by default", "file", 0.95),
        },
        [
            ("bodies", "cameras", ""),
            ("cameras", "perception", ""),
            ("perception", "estimation", ""),
            ("estimation", "guidance", ""),
            ("guidance", "allocation", ""),
            ("truth", "bodies", ""),
            ("allocation", "bodies", "pulses", -0.15),
        ],
        margin=0.4,
    )


def extend() -> None:
    diagram(
        "extend",
        {
            "image": Box(0, 1, "image", "file", 0.6),
            "perception": Box(1.15, 1, "perception\nentry point", "person"),
            "estimator": Box(2.5, 1, "estimator\nentry point", "person"),
            "guidance": Box(3.7, 1, "guidance"),
            "solver": Box(4.9, 1, "solver\nentry point", "person"),
            "chaser": Box(1.15, 0.1, "chaser process\nor yours", "person"),
            "controller": Box(3.7, 0.1, "controller process\nor yours", "person", 0.95),
        },
        [
            ("image", "perception", ""),
            ("perception", "estimator", "sighting"),
            ("estimator", "guidance", ""),
            ("guidance", "solver", ""),
            ("chaser", "perception", "runs"),
            ("controller", "estimator", "runs"),
            ("controller", "solver", "runs"),
        ],
        (1.6, 0.95),
    )


def knowledge() -> None:
    diagram(
        "knowledge",
        {
            "file": Box(0, 0.5, "scenario\nfile", "file", 0.6),
            "world": Box(1.3, 0.5, "world\nScenario", "simulated"),
            "flight": Box(3.4, 1, "chasers, controller, standby\nFlightScenario", "real", 1.35),
            "log": Box(3.4, 0, "recorder, judge, viewer\nScenario", "file", 1.35),
        },
        [
            ("file", "world", ""),
            ("world", "flight", "join reply"),
            ("world", "log", "truth/scenario"),
        ],
    )


def ros2() -> None:
    diagram(
        "ros2",
        {
            "mission": Box(0, 0.5, "mission\nworld, chasers,\ncontroller", "real", 0.85, 0.75),
            "bridge": Box(2, 0.5, "chaserdock ros2"),
            "ros": Box(4, 0.5, "ROS 2\nrviz2, nodes, bags", "person", 0.9),
        },
        [
            ("mission", "bridge", "everything but truth", -0.2),
            ("bridge", "mission", "operator commands", -0.2),
            ("bridge", "ros", "topics, tf, clock", -0.2),
            ("ros", "bridge", "services", -0.2),
        ],
    )


def devices() -> None:
    diagram(
        "devices",
        {
            "camera": Box(0, 1.8, "camera", "real", 0.7),
            "pose": Box(0, 1.2, "odometry,\nmotion capture", "real", 0.7, 0.5),
            "robot": Box(0, 0.6, "robot", "real", 0.7),
            "latch": Box(0, 0.0, "latch", "real", 0.7),
            "gateway": Box(2.4, 0.9, "chaserdock\ngateway", "real", 0.8, 0.75),
        },
        [
            ("camera", "gateway", "ros2:", 0.0),
            ("pose", "gateway", "ros2:  mavlink:", 0.0),
            ("gateway", "robot", "ros2:  px4:  mavlink:", 0.0),
            ("gateway", "latch", "ros2:  px4:  mavlink:", 0.0),
            ("latch", "gateway", "", 0.0),
        ],
    )


def laboratory() -> None:
    diagram(
        "laboratory",
        {
            "cameras": Box(0, 2, "cameras", "person", 0.8),
            "capture": Box(0, 1, "motion\ncapture", "person", 0.8),
            "robots": Box(0, 0, "robots,\nlatches", "person", 0.8),
            "gateway": Box(2, 1, "gateway\nclocks, axes, arming,\nlimits", "real", 1.0, 0.75),
            "mission": Box(4, 1, "chasers,\ncontroller"),
            "recorder": Box(2, 0, "recorder, viewer", "file", 0.9),
            "operator": Box(2, 2, "operator:\narm, kill", "person", 0.8),
        },
        [
            ("cameras", "gateway", "images"),
            ("capture", "gateway", "poses"),
            ("gateway", "robots", "forces or pulses"),
            ("gateway", "mission", "odometry, images", -0.2),
            ("mission", "gateway", "commands", -0.2),
            ("gateway", "recorder", "references"),
            ("mission", "recorder", ""),
            ("operator", "gateway", ""),
        ],
    )


def frames() -> None:
    """World, chaser, target and image frame."""
    with styled("frames"):
        figure = Figure(figsize=(7.0, 3.6))
        figure.set_layout_engine("none")
        axes: Any = figure.add_axes((-0.2, -0.8, 1.4, 2.6), projection="3d", computed_zorder=False)
        q_target = rotations.exp([0.2, -0.25, 0.5])
        q_chaser = rotations.exp([0.0, 0.0, 0.15])
        camera = rotations.exp([0.0, 0.0, 0.15])
        target, chaser = np.array([2.6, 0.5, 0.9]), np.array([0.6, 0.1, 0.9])
        lens = chaser + rotations.rotate(q_chaser, [0.55, 0.0, 0.35])
        image = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # IRF in CRF
        for name, at, vectors in (
            ("WRF", np.zeros(3), np.eye(3)),
            ("CRF", chaser, [rotations.rotate(q_chaser, v) for v in np.eye(3)]),
            ("TRF", target, [rotations.rotate(q_target, v) for v in np.eye(3)]),
            ("IRF", lens, [0.55 * rotations.rotate(camera, v) for v in image]),
        ):
            for k, vector in enumerate(vectors):
                tip = np.asarray(vector) * 0.6
                axes.quiver(*at, *tip, color=(SERIES[1], SERIES[2], SERIES[0])[k], linewidth=1.8)
                axes.text(*(at + 1.18 * tip), "xyz"[k], fontsize=8)
            axes.text(*(at - [0.0, 0.0, 0.22]), name, fontsize=10, weight="bold")
        axes.plot(*np.stack([target, chaser]).T, color=FAINT, linestyle=":")
        axes.text(*((target + chaser) / 2 + [0, 0, 0.1]), "p_off, q_off", fontsize=9, color=FAINT)
        axes.plot(*np.stack([np.zeros(3), target]).T, color=GRID)
        axes.text(*(target / 2 - [0, 0, 0.18]), "p_tar, q_tar", fontsize=9, color=FAINT)
        axes.set(xlim=(-0.1, 3.4), ylim=(-0.6, 1.4), zlim=(-0.1, 1.7))
        axes.set_box_aspect((3.5, 2.0, 1.8), zoom=0.78)
        axes.view_init(elev=20, azim=-62)
        axes.axis("off")
        save(figure, "frames")


# -- flights ---------------------------------------------------------------------------------------


@cache
def flight(scenario: str) -> RecordedFlight:
    """Return the flight of a scenario, a shipped one or ``docs-faults``, flown unless its log is
    there."""
    log = logs / scenario / "run"
    if not log.exists():
        logs.mkdir(parents=True, exist_ok=True)
        source = scenario
        if scenario == "docs-faults":
            source = str(logs / f"{scenario}.toml")
            Path(source).write_text(FAULTS.format(shipped="fault-drill"), encoding="utf-8")
        chaserdock("simulate", source, "--out", str(logs))
    return load_flight(log)


def chaserdock(*arguments: str) -> str:
    """Run a command of chaserdock and return what it printed."""
    command = [sys.executable, "-m", "chaserdock", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def save(figure: Figure, name: str, quality: int = 80) -> None:
    """Write a figure as docs/images/NAME.webp."""
    figure.savefig(
        IMAGES / f"{name}.webp", dpi=120, facecolor="white", pil_kwargs={"quality": quality}
    )


def controller() -> None:
    """Paths in the target's frame, keep-out and corridors of ``four-chaser-docking``."""
    f = flight("four-chaser-docking")
    target, s = f.motion["target"], f.scenario
    with styled():
        figure = Figure(figsize=(6.4, 5.0))
        axes = figure.add_subplot()
        axes.add_patch(
            Circle(
                (0, 0), s.limits.min_distance_target_m, color=GRID, label="keep-out of the target"
            )
        )
        half = np.radians(s.docking.corridor_angle_deg)
        for i in (0, 3):
            side = np.sign(s.chasers[i].position_m[0])
            reach = 1.15
            edge = np.tan(half) * reach
            axes.add_patch(
                Polygon(
                    [(0.15 * side, 0.0), (reach * side, edge), (reach * side, -edge)],
                    color=SERIES[2],
                    alpha=0.18,
                    label="corridors of 0 and 3" if i == 0 else None,
                )
            )
        for i in f.shown:
            own = f.motion[f"chaser/{i}"]
            path = rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
            axes.plot(*path[:, :2].T, color=colour(i), label=f"chaser {i}")
            axes.plot(*path[0, :2], "o", color=colour(i), markersize=4)
            axes.plot(*path[-1, :2], "^", color=colour(i), markersize=6)
        axes.set(xlabel="x of TRF / m", ylabel="y of TRF / m", aspect="equal")
        axes.legend(loc="lower right", fontsize=7.5)
        save(figure, "controller")


def assurance() -> None:
    """Range and force of a chaser that is commanded full force towards the target."""
    scenario = load_scenario(ROOT / "scenarios" / "four-chaser-docking.toml")
    body, limits = scenario.chaser, scenario.limits
    interval_s = 1.0 / scenario.time.rate_hz
    most = body.force_max_N / body.mass_kg
    with styled():
        figure = Figure(figsize=(6.4, 4.4))
        top, bottom = figure.subplots(2, 1, sharex=True)
        for k, share in enumerate((0.25, 0.5, 1.0)):
            distance_m, closing_m_s, rows = 1.5, 0.0, []
            for tick in range(300):
                room = distance_m - limits.min_distance_target_m
                barrier = Barrier("target", np.eye(3)[0], room, -closing_m_s)
                least = barrier.least_acceleration(share * most, interval_s)
                given = min(max(-most, least), most)
                rows.append((tick * interval_s, distance_m, given * body.mass_kg))
                distance_m += -closing_m_s * interval_s + 0.5 * given * interval_s**2
                closing_m_s -= given * interval_s
            time_s, far_m, force_N = np.array(rows).T
            top.plot(time_s, far_m, color=SERIES[k], label=f"braking_share = {share:g}")
            bottom.step(time_s, force_N, where="post", color=SERIES[k])
        top.axhline(limits.min_distance_target_m, color=LIMIT, linestyle=(0, (5, 3)))
        bottom.axhline(-body.force_max_N, color=INK, linestyle=":", label="as commanded")
        top.set(ylabel="range / m", ylim=(0.0, None))
        bottom.set(ylabel="outward force / N", xlabel="time / s")
        top.legend(loc="upper right", fontsize=7.5)
        bottom.legend(loc="lower right", fontsize=7.5)
        save(figure, "assurance")


def planar() -> None:
    """``planar-docking`` from above: paths, bodies at the start and when the latches hold."""
    f = flight("planar-docking")
    s, end = f.scenario, len(f.motion["target"].time_s) - 1
    sizes = dict.fromkeys(f.motion, s.chaser.size_m) | {"target": s.target_model().size_m}
    with styled():
        figure = Figure(figsize=(6.4, 4.6))
        axes = figure.add_subplot()
        for name, own in sorted(f.motion.items(), reverse=True):
            shade = INK if name == "target" else colour(int(name.partition("/")[2]))
            half = np.array(sizes[name]) / 2.0
            corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * half
            tip = np.array([[half[0], 0.0, 0.0], [s.chaser.probe_reach_m, 0.0, 0.0]])
            axes.plot(*own.position_m[:, :2].T, color=shade, label=name.replace("/", " "))
            for k, alpha in ((0, 0.15), (end, 0.45)):
                at, q = own.position_m[k], own.q_wxyz[k]
                outline = (at + rotations.rotate(np.tile(q, (4, 1)), corners))[:, :2]
                axes.add_patch(Polygon(outline, facecolor=shade, edgecolor=shade, alpha=alpha))
                if name != "target":
                    probe = (at + rotations.rotate(np.tile(q, (2, 1)), tip))[:, :2]
                    axes.plot(*probe.T, color=shade, alpha=2.0 * alpha, linewidth=2.5)
        axes.set(xlabel="x of WRF / m", ylabel="y of WRF / m", aspect="equal")
        axes.legend(loc="upper right", fontsize=7.5)
        save(figure, "planar")


def estimation() -> None:
    """Error of a chaser's estimated relative position, with three standard deviations."""
    f = flight("four-chaser-docking")
    relative, target, own = f.relative[1], f.motion["target"], f.motion["chaser/1"]
    rows = np.searchsorted(target.time_s, relative.time_s + 1e-6) - 1
    true_position = rotations.rotate_inverse(
        target.q_wxyz[rows], own.position_m[rows] - target.position_m[rows]
    )
    true_q = rotations.multiply(rotations.conjugate(target.q_wxyz[rows]), own.q_wxyz[rows])
    error = pose_error(true_position, true_q, relative.position_m, relative.q_wxyz)
    sigma = np.sqrt(
        np.diagonal(relative.covariance(np.arange(len(relative.time_s))), axis1=1, axis2=2)
    )
    with styled():
        figure = Figure(figsize=(8.0, 3.4))
        for k, axes in enumerate(figure.subplots(3, 1, sharex=True)):
            bound = 3e3 * sigma[:, k]
            axes.fill_between(relative.time_s, -bound, bound, color=GRID, label="stated 3 sigma")
            axes.plot(relative.time_s, 1e3 * error[:, k], color=SERIES[0], label="error")
            axes.set(ylabel=f"{'xyz'[k]} / mm", xlim=(0, 60), ylim=(-6, 6))
        figure.axes[0].legend(loc="upper right", ncols=2)
        figure.axes[-1].set_xlabel("time / s")
        save(figure, "estimation")


def detumble() -> None:
    """Rate of the target of ``detumble``, and when the chasers latch."""
    f = flight("detumble")
    target = f.motion["target"]
    with styled():
        figure = Figure(figsize=(8.0, 2.9))
        axes = figure.add_subplot()
        rate = np.degrees(np.linalg.norm(target.omega_rad_s, axis=1))
        axes.plot(target.time_s, rate, color=SERIES[0])
        for i, history in f.references.items():
            for time_s, phase in history.phases:
                if phase in ("latched", "detumble"):
                    axes.axvline(time_s, color=colour(i), linestyle=":", linewidth=1.0)
                if phase == "latched":
                    axes.annotate(
                        f"{i} latches", (time_s, 0.4), rotation=90, fontsize=8, xytext=(-10, 0),
                        textcoords="offset points", color=colour(i),
                    )  # fmt: skip
        axes.set(xlabel="time / s", ylabel="rate of the target / deg s⁻¹", ylim=(0, None))
        axes.set_xlim(0, float(target.time_s[-1]))
        save(figure, "detumble")


def docking() -> None:
    """Distance of the probe's tip from the port of ``docking-contact``, by phase."""
    f = flight("docking-contact")
    s, target, own = f.scenario, f.motion["target"], f.motion["chaser/0"]
    port = s.docking.ports[0]
    reach = np.array([s.chaser.probe_reach_m, 0.0, 0.0])
    tip = own.position_m + rotations.rotate(own.q_wxyz, np.tile(reach, (len(own.time_s), 1)))
    from_port = rotations.rotate_inverse(target.q_wxyz, tip - target.position_m)
    from_port = from_port - np.asarray(port.position_m)
    axis = np.asarray(port.axis) / np.linalg.norm(port.axis)
    along = from_port @ axis
    lateral = np.linalg.norm(from_port - along[:, None] * axis, axis=1)
    with styled():
        figure = Figure(figsize=(8.0, 3.2))
        axes = figure.add_subplot()
        axes.semilogy(own.time_s, np.maximum(along, 1e-4), color=SERIES[0], label="along the axis")
        axes.semilogy(own.time_s, np.maximum(lateral, 1e-4), color=SERIES[1], label="lateral")
        phases = [p for p in f.references[0].phases if p[0] > 1.0]
        for number, (time_s, phase) in enumerate(phases):
            axes.axvline(time_s, color=FAINT, linestyle=":", linewidth=0.8)
            axes.annotate(
                phase, (time_s, 2.2 / 1.7 ** (number % 4)), fontsize=8, xytext=(3, 0),
                textcoords="offset points",
            )  # fmt: skip
        axes.set(xlabel="time / s", ylabel="distance of the tip from the port / m")
        axes.set(ylim=(3e-4, 3.0), xlim=(0, float(own.time_s[-1])))
        axes.legend(loc="upper right")
        save(figure, "docking")


def faults() -> None:
    """Tracking errors of a flight with three faults."""
    f = flight("docs-faults")
    with styled():
        figure = Figure(figsize=(8.0, 3.0))
        axes = figure.add_subplot()
        for fault in f.scenario.fault:
            chaser = int(fault.process.rpartition("/")[2])
            end = fault.at_s + (fault.duration_s or 0.0)
            axes.axvspan(fault.at_s, end, color=colour(chaser), alpha=0.13, linewidth=0)
            axes.annotate(
                f"{fault.kind}\n{fault.process}", (fault.at_s, 700), fontsize=8, va="top",
                xytext=(3, 0), textcoords="offset points", color=colour(chaser),
            )  # fmt: skip
        for i in f.shown:
            time_s, position, _ = tracking_errors(f, i)
            axes.semilogy(time_s, 1e3 * position, color=colour(i), label=f"chaser {i}")
        axes.set(xlabel="time / s", ylabel="position error / mm", ylim=(0.1, 900))
        axes.set_xlim(0, f.scenario.duration_s)
        axes.legend(loc="lower right", ncols=4, fontsize=7.5)
        save(figure, "faults")


def unknown() -> None:
    """Points that a chaser follows in ``unknown-approach``, landmarks and others, and the error of
    the maps' rate.
    """
    f, at_s = flight("unknown-approach"), 100.0
    image: Image | None = None
    tracks: FeatureTracks | None = None
    for record in read_log(logs / "unknown-approach" / "run"):
        message = record.message
        if message.sim_time_ns != round(at_s * 1e9):
            continue
        if isinstance(message, Image) and message.chaser == 0:
            image = message
        elif isinstance(message, FeatureTracks) and message.chaser == 0:
            tracks = message
    assert image is not None
    assert tracks is not None
    newest = [m for m in f.maps if m.sim_time_ns <= tracks.sim_time_ns][-1]
    mapped = np.isin(tracks.ids, next(t.ids for t in newest.tracks if t.chaser == 0))
    px = np.reshape(tracks.places, (-1, 2)) * PX_STEP
    with styled():
        figure = Figure(figsize=(8.0, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        left.imshow(decode_image(image), cmap="gray", vmin=0, vmax=160)
        for chosen, text, kind in ((mapped, "landmarks", 0), (~mapped, "others", 1)):
            left.plot(*px[chosen].T, ".", markersize=2.5, color=colour(kind), label=text)
        left.set_axis_off()
        left.legend(loc="lower left", fontsize=7.5, labelcolor="white", frameon=False)
        errors = [(m.sim_time_ns / 1e9, rate_error(m, f.motion[TARGET])) for m in f.maps]
        known = [(t, 100.0 * e) for t, e in errors if e is not None]
        right.semilogy(*zip(*known, strict=True), "o-", markersize=3, color=colour(0))
        right.axvline(2.0 * np.pi / 0.0561, color="0.6", linestyle="--", linewidth=0.8)
        right.set(xlabel="time / s", ylabel="error of the rate / %", xlim=(0, f.flown_s))
        save(figure, "unknown-target")


def steady() -> None:
    """What ``settling_s`` divides."""
    f = flight("four-chaser-docking")
    s = f.scenario
    with styled():
        figure = Figure(figsize=(8.0, 2.6))
        axes = figure.add_subplot()
        time_s, position, _ = tracking_errors(f, 1)
        axes.semilogy(time_s, 1e3 * position, color=colour(1), label="chaser 1")
        end = s.steady_until_s or s.duration_s
        axes.axvspan(s.settling_s, end, color=SERIES[2], alpha=0.12, linewidth=0)
        axes.annotate("steady", (s.settling_s, 60), xytext=(4, 0), textcoords="offset points")
        axes.annotate("settling_s", (s.settling_s, 0.12), xytext=(4, 0), textcoords="offset points")
        if s.success.steady_position_rms_m is not None:
            limit = 1e3 * s.success.steady_position_rms_m
            axes.plot(
                [s.settling_s, end], [limit, limit], "--", color=LIMIT, label="limit of the RMS"
            )
        axes.set(xlabel="time / s", ylabel="position error / mm", xlim=(0, s.duration_s))
        axes.legend(loc="upper right")
        save(figure, "steady")


def thrusters() -> None:
    """Layout of ``tetra12``, and pulses of ``single-thrusters``."""
    from chaserdock.api import open_log

    flight("single-thrusters")
    body = BODIES["tetra12"]
    with styled():
        figure = Figure(figsize=(8.6, 3.4))
        left: Any = figure.add_subplot(1, 2, 1, projection="3d")
        half = np.asarray(body["size_m"]) / 2.0
        corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        for a in corners:
            for b in corners:
                if sum(p != q for p, q in zip(a, b, strict=True)) == 1:
                    left.plot(*np.stack([half * a, half * b]).T, color=FAINT, linewidth=0.7)
        for k, thruster in enumerate(body["thrusters"]):
            at, direction = np.asarray(thruster["position_m"]), np.asarray(thruster["direction"])
            left.quiver(*(at - 0.14 * direction), *(0.14 * direction), color=colour(k // 3))
            left.text(*(at - 0.18 * direction), str(k), fontsize=7)
        left.set_box_aspect((1, 1, 1), zoom=1.3)
        left.axis("off")
        left.set_title("forces of the twelve thrusters")
        right = figure.add_subplot(1, 2, 2)
        seen = set()
        for command in open_log(logs / "single-thrusters" / "run").messages("chaser/0/actuators"):
            for pulse in command.pulses:
                key = (pulse.thruster, pulse.open_ns, pulse.close_ns)
                begin, end = pulse.open_ns / 1e9, pulse.close_ns / 1e9
                if key not in seen and 2.0 <= begin < 4.0:
                    seen.add(key)
                    right.barh(
                        pulse.thruster, end - begin, left=begin, color=colour(pulse.thruster // 3)
                    )
        right.set(xlabel="time / s", ylabel="thruster", xlim=(2.0, 4.0), yticks=range(12))
        right.set_title("its valves, open")
        save(figure, "thrusters")


def results() -> None:
    """The table of docs/results.md: tracking of every scenario under three grades."""
    rows = re.findall(
        r"^\| `([\w-]+)` \| ([\d.]+) mm[^|]*\| ([\d.]+) mm[^|]*\| ([\d.]+) mm",
        (ROOT / "docs" / "results.md").read_text(encoding="utf-8"),
        re.M,
    )
    rows.sort(key=lambda row: -float(row[2]))
    with styled():
        figure = Figure(figsize=(8.0, 0.6 + 0.21 * len(rows)))
        axes = figure.add_subplot()
        for k, grade in enumerate(("exact", "lab", "orbit")):
            values = [float(row[1 + k]) for row in rows]
            axes.semilogx(values, range(len(rows)), "os^"[k], color=SERIES[k], label=grade)
        axes.set(xlabel="tracking, RMS of the worst chaser / mm")
        axes.set_yticks(range(len(rows)), [row[0] for row in rows])
        axes.legend(loc="upper right")
        save(figure, "results")


def tables_of_reproduction(text: str) -> dict[str, Any]:
    """Return the tables of errors of docs/reproduction.md by quantity."""
    from chaserdock.experiments.page import Table
    from chaserdock.experiments.reproduction.tables import QUANTITIES

    tables: dict[str, Any] = {}
    for quantity in QUANTITIES:
        part = text.partition(f"## Table: {quantity}\n")[2].partition("\n## ")[0]
        lines = [line for line in part.splitlines() if line.startswith("| ")]
        header, _, *rows = (tuple(c.strip() for c in line.split("|")[1:-1]) for line in lines)
        tables[quantity] = Table(header, tuple(rows))
    return tables


def reproduction() -> None:
    """The curves of docs/reproduction.md, from its tables."""
    from chaserdock.experiments.page import Picture
    from chaserdock.experiments.reproduction.curves import PATH, curves_section

    tables: Any = tables_of_reproduction((ROOT / "docs" / "reproduction.md").read_text("utf-8"))
    (picture,) = (p for p in curves_section(tables).parts if isinstance(p, Picture))
    (ROOT / "docs" / PATH).write_text(picture.file, encoding="utf-8")


# -- cameras ---------------------------------------------------------------------------------------


def targets() -> None:
    """Shipped targets as the camera sees them."""
    tiles = []
    for model in ("servicer", "geo_servicer", "cubesat_12u"):
        sets = [f"target.model='{model}'", "camera.sun_direction=[-0.8, -0.3, 0.5]"]
        if model != "servicer":
            sets.append("perception.name='model'")
        scenario = load_scenario(ROOT / "scenarios" / "single.toml", tuple(sets))
        distance = {"servicer": 1.0, "geo_servicer": 1.7, "cubesat_12u": 1.0}[model]
        q = rotations.exp([0.25, 0.35, 0.45])
        states = {TARGET: BodyState(np.array([distance, 0.0, 0.0]), np.zeros(3), q, np.zeros(3))}
        still = np.zeros(3)
        states["chaser/0"] = BodyState(still, still, np.array([1.0, 0.0, 0.0, 0.0]), still)
        image = Cameras(scenario).image(0, 0, 0, 0, states)
        grey: Any = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        height, width = grey.shape
        middle = grey[:, (width - height) // 2 : (width + height) // 2]
        tiles.append(cv2.resize(middle, (300, 300), interpolation=cv2.INTER_AREA))
    write("targets", np.hstack(tiles))


def tracked() -> None:
    """A printed sheet in a photograph, as `chaserdock track` shows it."""
    sys.path.insert(0, str(ROOT / "tests"))
    from chaserdock_models.targets import target_model
    from sheet_views import Lens, Photograph, printed, rotation_of

    from chaserdock.tracking.overlay import overlay
    from chaserdock.tracking.tracker import Tracker

    lens = Lens(960, 540, 840.0, 840.0, 478.2, 272.9, samples=4)
    paper = target_model("paper")
    tracker = Tracker(lens.camera(), {0: 0.09, 1: 0.09}, dictionary=paper.dictionary)
    rotation = rotation_of([0.35, -0.5, 1.25]) @ np.diag([1.0, -1.0, -1.0])
    position, rng = np.array([0.02, 0.015, 0.5]), np.random.default_rng(1)
    image = Photograph(lens).of(printed(paper), position, rotation, rng)
    seen = tracker.track(image, 12_340_000_000)
    write("track", overlay(image, tracker.camera, tracker.models, seen, 30.0))


def dataset() -> None:
    """Images of random views, and the masks of the target."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "ds"
        chaserdock(
            "dataset", "markerless-docking", "--images", "4", "--out", str(out), "--format",
            "speed+", "--seed", "3", "--quiet",
        )  # fmt: skip
        rows = [
            np.hstack(
                [
                    cv2.resize(
                        np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)),
                        (240, 135),
                        interpolation=cv2.INTER_AREA,
                    )
                    for path in sorted(folder.glob("*.png"))
                ]
            )
            for folder in (
                out / "speedplus" / "synthetic" / "images",
                out / "speedplus" / "synthetic" / "masks",
            )
        ]
    write("dataset", np.vstack(rows))


def learning() -> None:
    """Starts of a training environment, as it renders itself."""
    tiles = []
    for seed in (1, 3, 5):
        environment = make(ROOT / "examples" / "learning" / "docking.toml", render_mode="rgb_array")
        environment.reset(seed=seed)
        picture = environment.render()
        assert picture is not None
        tiles.append(picture[80:400, 100:540, ::-1])
    write("learning", np.hstack(tiles))


def learning_curve() -> None:
    """Episodes of each batch while the policy of the example was trained, as it was recorded."""
    text = (ROOT / "examples" / "learning" / "docking-curve.json").read_text("utf-8")
    batches = [b for b in json.loads(text) if b["episodes"] >= LEAST_EPISODES]
    steps = [b["steps"] / 1e6 for b in batches]
    shown = (
        ("return", "return", 1.0), ("duration_s", "duration / s", 1.0),
        ("success", "success / %", 100.0),
    )  # fmt: skip
    with styled():
        figure = Figure(figsize=(6.4, 4.6))
        rows = figure.subplots(3, 1, sharex=True)
        for axes, shade, (name, label, scale) in zip(rows, SERIES, shown, strict=False):
            values = [scale * b[name] for b in batches]
            axes.plot(steps, values, ".", color=shade, markersize=3)
            axes.set(ylabel=label)
        took_min = batches[-1]["cpu_s"] / 60.0
        rows[-1].set(xlabel=f"million steps ({took_min:.0f} min of processor time)")
        save(figure, "learning-curve")


def write(name: str, image: np.ndarray) -> None:
    """Write grey levels, or colours (BGR), as docs/images/NAME.webp."""
    cv2.imwrite(str(IMAGES / f"{name}.webp"), image, [cv2.IMWRITE_WEBP_QUALITY, 80])


def report() -> None:
    """Some figures of a report, side by side."""
    flight("docking-contact")
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        log = str(logs / "docking-contact" / "run")
        chaserdock("report", log, "--figures", "--out", name, "--format", "png")
        tiles = []
        for figure in ("approach", "docking", "tracking", "effort"):
            image = np.asarray(cv2.imread(str(out / f"{figure}.png")))
            scale = min(480 / image.shape[1], 260 / image.shape[0])
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            tile = np.full((260, 480, 3), 255, np.uint8)
            y, x = (260 - small.shape[0]) // 2, (480 - small.shape[1]) // 2
            tile[y : y + small.shape[0], x : x + small.shape[1]] = small
            tiles.append(tile)
    write("report", np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))


def campaign() -> None:
    """The upper part of the report of a campaign, in a browser."""
    sys.path.insert(0, str(ROOT / "tests"))
    from browser import chromium

    logs.mkdir(parents=True, exist_ok=True)
    file, out = logs / "docs-campaign.toml", logs / "docs-campaign"
    file.write_text(CAMPAIGN, encoding="utf-8")
    chaserdock("campaign", str(file), "--out", str(out), "--keep-logs", "none")
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 960, "height": 1200})
        page.goto((out / "report.html").as_uri())
        title = page.locator("h2", has_text="Outcomes by cause").bounding_box()
        end = page.locator("figure").nth(3).bounding_box()
        assert title is not None
        assert end is not None
        height = end["y"] + end["height"] - title["y"]
        shot = page.screenshot(
            full_page=True, clip={"x": 0.0, "y": title["y"], "width": 960.0, "height": height}
        )
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)
    write("campaign", np.asarray(image))


# -- terminals -------------------------------------------------------------------------------------


def terminal(name: str, command: str, lines: list[str]) -> None:
    """Write what a command printed as docs/images/NAME.svg."""
    shown = [f"$ {command}", *(line[:98] for line in lines)]
    with styled(name):
        figure = Figure(figsize=(8.0, 0.2 + 0.165 * len(shown)), facecolor="#20242b")
        for k, line in enumerate(shown):
            figure.text(
                0.02, 1.0 - (k + 0.95) / (len(shown) + 1.0), line, va="center", fontsize=8,
                family="monospace", color="#ffffff" if k == 0 else "#c9d1d9", parse_math=False,
            )  # fmt: skip
        figure.savefig(IMAGES / f"{name}.svg", facecolor="#20242b", metadata={"Date": None})


def first_flight() -> None:
    out = logs / "first"
    if not out.exists():
        chaserdock(
            "run", "single", "--set", "duration_s=20", "--set", "success={}", "--out", str(out)
        )
    command = "chaserdock run single --set duration_s=20 --set 'success={}' --out runs/first"
    terminal("terminal", command, chaserdock("judge", str(out)).splitlines()[:14])


def log_info() -> None:
    flight("docking-contact")
    log = str(logs / "docking-contact" / "run")
    text = chaserdock("log", log).replace(log, "runs/capture")
    terminal("status", "chaserdock log runs/capture", text.splitlines()[:16])


PICTURES: dict[str, Callable[[], None]] = {
    "processes": processes, "simulation": simulation, "redundancy": redundancy,
    "spread": spread,
    "perception": perception, "errors": errors, "hosts": hosts, "limits": limits,
    "extend": extend, "knowledge": knowledge, "ros2": ros2, "devices": devices, "frames": frames,
    "laboratory": laboratory, "planar": planar,
    "assurance": assurance, "controller": controller, "estimation": estimation,
    "detumble": detumble,
    "docking": docking, "faults": faults, "steady": steady,
    "unknown-target": unknown,
    "results": results, "reproduction-curves": reproduction, "thrusters": thrusters,
    "targets": targets, "track": tracked, "dataset": dataset, "report": report,
    "campaign": campaign, "learning": learning, "learning-curve": learning_curve,
    "terminal": first_flight, "status": log_info,
}  # fmt: skip


def main() -> None:
    global logs
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}")
    parser.add_argument("--logs", type=Path, default=logs, help="folder of the flights")
    options = parser.parse_args()
    if wrong := set(options.names) - PICTURES.keys():
        parser.error(f"no such picture: {', '.join(sorted(wrong))}")
    logs = options.logs
    for name in options.names or PICTURES:
        PICTURES[name]()
        print(name, flush=True)


if __name__ == "__main__":
    main()
