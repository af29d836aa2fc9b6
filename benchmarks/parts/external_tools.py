# SPDX-License-Identifier: Apache-2.0
"""A log read by independent programs, which are installed into a virtual environment of their own.

- evo_ape on the tracks of ``chaserdock log --export --format tum``: root mean square errors within
  1 % of ours;
- pymcap-cli doctor: no error;
- the reader of the mcap package: every channel has a schema, every message is readable;
- rerun: draws the log without a window and saves the image to ``--image``. Without a graphics card
  it needs Mesa's Vulkan driver (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import venv
import zipfile
from argparse import ArgumentParser
from pathlib import Path

import cv2
import numpy as np
from chaserdock_protocol.shipped_scenarios import find_scenario
from common import BenchmarkFailed, Figures, Group, Options

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import estimate_errors
from chaserdock.logs.tracks import write_tracks
from chaserdock.simulation.mission import simulate

PACKAGES = ("evo", "pymcap-cli", "mcap", "mcap-ros2-support-fast", "rerun-sdk")
TOLERANCE = 0.01
"""Largest difference of evo's and our errors, share."""
LEAST_GREY_LEVELS = 64
"""An image of an empty window has fewer."""

READ = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    without = [c.topic for c in summary.channels.values() if c.schema_id not in summary.schemas]
    read = sum(1 for _ in reader.iter_messages())
print(len(summary.channels), len(without), read, summary.statistics.message_count)
"""

CheckedFigures = tuple[Figures, bool]
"""Figures, and whether they are as they should be."""


def call(*command: str | Path, **environment: str) -> str:
    """Run a program and return its output. Raise RuntimeError if it fails."""
    done = subprocess.run(
        [str(c) for c in command],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode:
        output = done.stdout.strip()[-500:]
        raise RuntimeError(f"{Path(command[0]).name}: status {done.returncode}: {output}")
    return done.stdout


def install_tools(folder: Path) -> Path:
    """Install the tools unless they are there; return the folder of their programs."""
    programs = folder / "bin"
    if not (programs / "rerun").exists():
        venv.create(folder, with_pip=True)
        call(programs / "pip", "install", "-q", *PACKAGES)
    return programs


def evo(programs: Path, log: Path, work: Path) -> CheckedFigures:
    """Compare the errors of the target estimate by evo with ours."""
    write_tracks(log, work)
    errors = estimate_errors(load_flight(log))
    tracks = work / "target_truth.tum", work / "target_estimate.tum"
    figures: Figures = {}
    for relation, key in (("trans_part", "position_m"), ("angle_rad", "orientation_rad")):
        result = work / f"{relation}.zip"
        call(
            programs / "evo_ape",
            "tum",
            *tracks,
            "-r",
            relation,
            "--save_results",
            result,
            HOME=str(work),
        )
        with zipfile.ZipFile(result) as archive:
            figures[f"evo_rms_{key}"] = float(json.loads(archive.read("stats.json"))["rmse"])
        figures[f"our_rms_{key}"] = float(np.sqrt(np.mean(errors[key] ** 2)))
    ratios = [
        figures[f"evo_rms_{k}"] / figures[f"our_rms_{k}"] for k in ("position_m", "orientation_rad")
    ]
    return figures, all(abs(ratio - 1.0) <= TOLERANCE for ratio in ratios)


def doctor(programs: Path, log: Path) -> CheckedFigures:
    """Check the log with pymcap-cli. Raise RuntimeError for an output without verdict."""
    output = call(programs / "pymcap-cli", "doctor", log, COLUMNS="400")
    found = re.search(r"(\d+) errors, (\d+) warnings", output)
    if found is None:
        raise RuntimeError(f"pymcap-cli doctor: no verdict: {output.strip()[-200:]}")
    return {"pymcap_errors": int(found[1]), "pymcap_warnings": int(found[2])}, found[1] == "0"


def mcap_reader(programs: Path, log: Path) -> CheckedFigures:
    """Read all messages with the reader of the mcap package."""
    channels, without_schema, read, total = map(
        int, call(programs / "python", "-c", READ, log).split()
    )
    figures: Figures = {
        "mcap_channels": channels,
        "mcap_channels_without_schema": without_schema,
        "mcap_messages_read": read,
        "mcap_messages": total,
    }
    return figures, without_schema == 0 and read == total > 0


def has_vulkan() -> bool:
    """Return whether the Vulkan loader finds a driver: on Linux a file in one of its folders, or
    named by a variable; elsewhere true.
    """
    named = {"VK_DRIVER_FILES", "VK_ICD_FILENAMES"} & os.environ.keys()
    folders = (
        Path(root) / "vulkan" / "icd.d" for root in ("/usr/share", "/etc", "/usr/local/share")
    )
    return sys.platform != "linux" or bool(named) or any(any(f.glob("*.json")) for f in folders)


def rerun(programs: Path, log: Path, image: Path) -> CheckedFigures:
    """Draw the log with rerun. Raise RuntimeError without a driver."""
    if not has_vulkan():
        raise RuntimeError("needs a Vulkan driver (Debian: apt-get install mesa-vulkan-drivers)")
    image.unlink(missing_ok=True)
    call(
        programs / "rerun", "--headless", "--renderer", "vulkan", log, "--screenshot-to", image,
        "--window-size", "900x560", RUST_LOG="off",
    )  # fmt: skip
    drawn = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE) if image.exists() else None
    levels = 0 if drawn is None else len(np.unique(drawn))
    return {"rerun_grey_levels": levels}, levels > LEAST_GREY_LEVELS


def tools(options: Options) -> Figures:
    """Read ``--log`` (default: a new flight) by evo, pymcap-cli, mcap's own reader and rerun."""
    result, failed = Figures(), []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        log = options.log.resolve() if options.log else flown_log(work)
        programs = install_tools((options.tools or work / "tools").resolve())
        for tool, check in {
            "evo": lambda: evo(programs, log, work / "tracks"),
            "pymcap-cli": lambda: doctor(programs, log),
            "mcap": lambda: mcap_reader(programs, log),
            "rerun": lambda: rerun(programs, log, options.image.resolve()),
        }.items():
            try:
                figures, good = check()
            except (RuntimeError, subprocess.TimeoutExpired) as error:
                failed.append(f"{tool}: {error}")
                continue
            result |= figures
            if not good:
                failed.append(f"{tool}: not as it should be: {figures}")
    if failed:
        raise BenchmarkFailed("\n".join(failed), result)
    return result


def flown_log(folder: Path) -> Path:
    """Return the log of a short flight with images."""
    simulate(find_scenario("single"), folder / "run", ("duration_s=12.0", "settling_s=5.0"))
    return folder / "run" / "mission.mcap"


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--log", type=Path, help="of tools: mission.mcap")
    parser.add_argument("--tools", type=Path, metavar="DIR", help="environment of the tools, kept")
    parser.add_argument("--image", type=Path, metavar="PNG", default=Path("rerun.png"))


GROUP = Group({"tools": tools}, add_options=add_options, on_request=("tools",))
