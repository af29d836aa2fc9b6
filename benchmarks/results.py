# SPDX-License-Identifier: Apache-2.0
"""Options and output that all benchmarks share: ``--quick``, ``--json``, printed figures, and the JSON file."""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def options_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks; the description keeps its line breaks."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer or shorter runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE, too")
    return parser


def print_figures(figures: Mapping[str, float]) -> None:
    """Print one figure per line, aligned."""
    width = max(map(len, figures), default=0)
    for name, value in figures.items():
        print(f"{name:{width}}  {value:.5g}", flush=True)


def write_json(path: Path | None, figures: Mapping[str, object]) -> None:
    """Write the figures as a flat object, with command, commit and machine under ``about``; nothing without a path."""
    if path is None:
        return
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    about = {
        "command": " ".join(sys.argv),
        "commit": commit.stdout.strip(),
        "machine": f"{platform.machine()} {platform.platform()}",
        "date": f"{datetime.now():%Y-%m-%d}",
    }
    path.write_text(json.dumps({**figures, "about": about}, indent=2) + "\n")
