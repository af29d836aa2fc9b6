"""What every benchmark does with its figures: the options ``--quick`` and ``--json``, and the file they ask for."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path


def options_of(about: str | None) -> argparse.ArgumentParser:
    """A parser with the options that all benchmarks take."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="fewer or shorter runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="writes the figures to FILE as well")
    return parser


def write_json(path: Path | None, figures: Mapping[str, object]) -> None:
    """The figures as a flat object with the command, commit and machine beside them; nothing without a ``path``."""
    if path is None:
        return
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    about = {
        "command": " ".join(sys.argv),
        "commit": commit.stdout.strip(),
        "machine": f"{platform.machine()} {platform.platform()}",
        "date": f"{datetime.now():%Y-%m-%d}",
    }
    path.write_text(json.dumps({**figures, "about": about}, indent=2) + "\n")
