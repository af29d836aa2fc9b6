# SPDX-License-Identifier: Apache-2.0
"""Random input at every boundary: ``python benchmarks/fuzz.py [--only PART ...]``.

Decoders, scenario loader and log reader; C kernels under sanitizers; and our logs in the programs
of others. Status 1 if anything is found.
"""

from common import main
from parts import decoders, external_tools, kernels

GROUPS = (
    decoders.GROUP,
    kernels.GROUP,
    external_tools.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
