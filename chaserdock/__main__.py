# SPDX-License-Identifier: Apache-2.0
"""``python -m chaserdock``: the ``chaserdock`` program."""

import os
import signal

from chaserdock.exit_codes import STOPPED


def main() -> None:
    """Run the program. Signals end it with ``STOPPED`` even while it imports its modules."""
    for number in (signal.SIGTERM, signal.SIGINT):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: os._exit(STOPPED))
    from chaserdock.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
