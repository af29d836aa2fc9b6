# SPDX-License-Identifier: Apache-2.0
"""What other people's programs make of a log: ``python benchmarks/outside.py LOG [--tools DIR] [--image PNG]
[--json FILE]``.

Installs evo, pymcap-cli, mcap and rerun into a virtual environment of their own (``--tools``: kept there, else made anew
in a temporary folder; none of them is a dependency), and asks each about the log:

- evo_ape on the tracks that ``chaserdock log tracks`` wrote: our root mean squares to 1 %;
- pymcap-cli doctor: no error;
- mcap's own reader: a schema for every channel, every message readable;
- rerun without a window: takes an image of itself with the log open (``--image``; look at it). Without a graphics card it
  needs Mesa's Vulkan (Debian: mesa-vulkan-drivers).

Status 1 when one of them does not agree.
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
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from results import options_of, write_json

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import estimate_errors
from chaserdock.logs.tracks import write_tracks

PACKAGES = ("evo", "pymcap-cli", "mcap", "mcap-ros2-support-fast", "rerun-sdk")
WITHIN = 0.01

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

Answer = tuple[str, str, bool]
"""What was asked, what came, and whether it is as it should be."""


def call(*command: str | Path, **environment: str) -> str:
    """All that a program says; raises RuntimeError with it if the program fails."""
    done = subprocess.run(
        [str(c) for c in command],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    said = done.stdout + done.stderr
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name}: status {done.returncode}: {said.strip()[-500:]}")
    return said


def tools_in(folder: Path) -> Path:
    """The folder of the tools' programs; installed unless they are there."""
    programs = folder / "bin"
    if not (programs / "rerun").exists():
        venv.create(folder, with_pip=True)
        call(programs / "pip", "install", "-q", *PACKAGES)
    return programs


def evo(programs: Path, log: Path, work: Path) -> Iterator[Answer]:
    """Errors of the target's estimate, by evo and by ourselves."""
    write_tracks(log, work)
    errors = estimate_errors(load_flight(log))
    tracks = work / "target_truth.tum", work / "target_estimate.tum"
    for relation, ours, unit in (
        ("trans_part", errors["position_m"], "m"),
        ("angle_rad", errors["orientation_rad"], "rad"),
    ):
        own = float(np.sqrt(np.mean(ours**2)))
        result = work / f"{relation}.zip"
        call(programs / "evo_ape", "tum", *tracks, "-r", relation, "--save_results", result, HOME=str(work))
        with zipfile.ZipFile(result) as archive:
            theirs = float(json.loads(archive.read("stats.json"))["rmse"])
        yield (
            f"evo_ape, {relation}",
            f"{theirs:.4e} {unit}, ours {own:.4e} {unit}",
            abs(theirs / own - 1.0) <= WITHIN,
        )


def doctor(programs: Path, log: Path) -> Answer:
    """The verdict of pymcap-cli."""
    said = call(programs / "pymcap-cli", "doctor", log, COLUMNS="400")
    found = re.search(r"(\d+) errors, (\d+) warnings", said)
    return (
        "pymcap-cli doctor",
        found.group(0) if found else said.strip()[-200:],
        found is not None and found[1] == "0",
    )


def plain_reader(programs: Path, log: Path) -> Answer:
    """What mcap's own reader finds."""
    channels, without, read, stated = map(int, call(programs / "python", "-c", READ, log).split())
    told = f"{channels} channels, {without} without a schema; {read} of {stated} messages read"
    return "mcap's reader", told, without == 0 and read == stated > 0


def rerun(programs: Path, log: Path, image: Path) -> Answer:
    """Whether rerun draws something with the log open."""
    image.unlink(missing_ok=True)
    call(
        programs / "rerun", "--headless", "--renderer", "vulkan", log, "--screenshot-to", image,
        "--window-size", "900x560", RUST_LOG="off",
    )  # fmt: skip
    drawn = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE) if image.exists() else None
    if drawn is None:
        return "rerun", "took no image", False
    levels = len(np.unique(drawn))
    return (
        "rerun",
        f"{drawn.shape[1]} x {drawn.shape[0]} pixels, {levels} grey levels: {image}",
        levels > 64,
    )


def main() -> int:
    parser = options_of(__doc__)
    parser.add_argument("log", type=Path, metavar="LOG", help="mission.mcap")
    parser.add_argument("--tools", type=Path, metavar="DIR", help="virtual environment of the tools, kept")
    parser.add_argument("--image", type=Path, metavar="PNG", default=Path("rerun.png"))
    options = parser.parse_args()
    log: Path = options.log.resolve()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        programs = tools_in((options.tools or work / "tools").resolve())
        answers = [*evo(programs, log, work / "tracks"), doctor(programs, log), plain_reader(programs, log)]
        answers.append(rerun(programs, log, options.image.resolve()))
    for asked, told, good in answers:
        print(f"{asked:20}  {told}  {'agrees' if good else 'DOES NOT'}")
    write_json(options.json, {asked: told for asked, told, _ in answers})
    return 0 if all(good for _, _, good in answers) else 1


if __name__ == "__main__":
    sys.exit(main())
