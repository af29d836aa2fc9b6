# SPDX-License-Identifier: Apache-2.0
"""Parts of the benchmarks, one module a subject; the commands are beside this folder.

Some use helpers of the tests, which are put on the path here.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
