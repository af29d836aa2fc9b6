# SPDX-License-Identifier: Apache-2.0
"""Record the golden logs: ``python tests/make_golden.py``. Only after a deliberate change of the
replies.

``two-chasers``: images through commands, of every process. ``capture``: one chaser docks on
thrusters and is verified; for the controller and the pilot, without images and truth.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from chaserdock_protocol import codec
from chaserdock_protocol.messages import BodyTruth, Image, PortLoad, WorldTruth, encoding_of
from chaserdock_protocol.recording.log import LogWriter, read_log, read_scenario
from harness import ROOT, run

GOLDEN = ROOT / "tests" / "golden"
IMAGES = ("camera.width_px=480", "camera.height_px=270", "camera.effects.jpeg_quality=85")
TWO_CHASERS = (
    "duration_s=1.2",
    "settling_s=0.5",
    *IMAGES,
    "timeline=[{at_s=0.6,command='approach',chasers=[0]}]",
)
CAPTURE = (
    "duration_s=29.0",
    "settling_s=0.5",
    "steady_until_s=1.0",
    "time.rate_hz=5",
    "time.image_hz=5",
    "controller.horizon_s=2.0",
    "docking.entry_m=0.2",
    "docking.final_m=0.06",
    *IMAGES,
    "timeline=[{at_s=1.0,command='approach',chasers=[0]}]",
)


def for_the_controller(log: Path, out: Path) -> None:
    """A copy without images, truth and the viewers' layer."""
    scenario, run = read_scenario(log)
    out.unlink(missing_ok=True)
    writer = LogWriter(out)
    writer.describe(scenario, {k: v for k, v in run.items() if k in ("run_id", "mode")})
    for record in read_log(log):
        if not isinstance(record.message, Image | BodyTruth | WorldTruth | PortLoad):
            payload = codec.encode(record.message)
            writer.write(record.key, encoding_of(type(record.message)), payload, record.sent_ns)
    writer.close()


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        for name, scenario, overrides in (
            ("two-chasers", "two-chaser-tracking", TWO_CHASERS),
            ("capture", "docking-contact", CAPTURE),
        ):
            flown = Path(folder) / name / "mission.mcap"
            run(scenario, flown.parent, *overrides)
            if not flown.exists():
                return 1
            golden = GOLDEN / f"{name}.mcap"
            if name == "two-chasers":
                golden.write_bytes(flown.read_bytes())
            else:
                for_the_controller(flown, golden)
            print(f"{golden}: {golden.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
