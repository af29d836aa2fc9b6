# SPDX-License-Identifier: Apache-2.0
"""``python -m chaserdock``, and the installed command: the ``chaserdock`` program."""

from __future__ import annotations

import os
import signal
import sys

from chaserdock.exit_codes import STOPPED


def main() -> None:
    """Run the program. Ctrl-C and SIGTERM end it in one line, also while it is being imported."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:  # as a shell starts background programs
            signal.signal(number, _exit_at_once)
    from chaserdock.cli.main import main as run

    run()


def _exit_at_once(*_: object) -> None:
    """End the process: there is nothing to clean up yet, and an exception in an import of C code
    would become another one.
    """
    os.write(sys.stderr.fileno(), b"chaserdock: stopped\n")
    os._exit(STOPPED)


if __name__ == "__main__":
    main()
