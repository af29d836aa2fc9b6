"""Records the golden log anew: ``python tests/make_golden.py``. Only after a deliberate change of what processes answer."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from harness import ROOT, run

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"
OVERRIDES = (
    "duration_s=1.2",
    "settling_s=0.5",
    "camera.width_px=480",
    "camera.height_px=270",
    "camera.effects.jpeg_quality=85",
    "timeline=[{at_s=0.6,command='approach',chasers=[0]}]",
)


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run("two-chaser-tracking", out, *OVERRIDES)
        if not (out / "mission.mcap").exists():
            return 1
        shutil.copy(out / "mission.mcap", GOLDEN)
    print(f"{GOLDEN}: {GOLDEN.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
