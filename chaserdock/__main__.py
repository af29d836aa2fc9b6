# SPDX-License-Identifier: Apache-2.0
"""``python -m chaserdock``: the ``chaserdock`` program."""

from chaserdock.cli.main import main

if __name__ == "__main__":
    main()
