# SPDX-License-Identifier: Apache-2.0
"""Command names of earlier versions, and their replacements."""

from __future__ import annotations

RENAMED = {
    "compose": "deploy",
    "evaluate": "dataset FOLDER",
    "figures": "report LOG --figures --out FOLDER",
    "keys": "deploy --keys FOLDER",
    "log export": "log LOG --export FOLDER",
    "log info": "log LOG",
    "log play": "play LOG",
    "log recover": "log LOG --recover FILE",
    "log tracks": "log LOG --export FOLDER --format tum",
    "markers": "target TARGET --markers FILE",
    "mesh": "target",
    "scenario list": "scenario",
    "scenario new": "scenario NAME --new",
    "scenario schema": "scenario --schema",
    "scenario show": "scenario NAME --show",
    "scenario validate": "scenario FILE",
    "snapshot": "report LOG --at SECONDS --out FILE",
    "study": "campaign FILE, with a table [alone] in the file",
    "summary": "judge LOG",
    "thruster-fault": "command thruster-fault",
}


def renamed(arguments: list[str]) -> str | None:
    """Return one line that names the present command; None if the name is not an earlier one."""
    for words in (1, 2):
        old = " ".join(arguments[:words])
        if old in RENAMED:
            return f"`chaserdock {old}` is now `chaserdock {RENAMED[old]}`"
    return None
