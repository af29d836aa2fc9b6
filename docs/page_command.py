# SPDX-License-Identifier: Apache-2.0
"""Command line of the scripts that generate a page: write it, or print it with ``--print``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def run(
    description: str | None, path: Path, page: Callable[[], str], **others: Callable[[], str]
) -> None:
    """Write ``page()`` to ``path``. With ``--print`` print it; with ``--print-NAME`` print what
    ``others[NAME]`` returns.
    """
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument(
        "--print", dest="text", action="store_const", const=page, help="print the page instead"
    )
    for name, text in others.items():
        choice.add_argument(
            f"--print-{name}",
            dest="text",
            action="store_const",
            const=text,
            help=f"print the {name}",
        )
    text = parser.parse_args().text
    if text is None:
        path.write_text(page(), encoding="utf-8")
    else:
        print(text(), end="")
