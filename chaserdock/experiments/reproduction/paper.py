# SPDX-License-Identifier: Apache-2.0
"""Results of the paper: Fourlas et al., IFAC 2023, table 2. Mean squares over two minutes, averaged
over three runs.
"""

from __future__ import annotations

from dataclasses import dataclass

PAPER_S = 120.0
"""Duration of each of the paper's runs."""


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's single-chaser table; ``failed`` of its three runs failed. ``name`` is a
    valid file name.
    """

    name: str
    horizon_s: float
    dt_s: float
    falloff: float
    position_mse_m2: float
    orientation_mse_rad2: float
    failed: int = 0

    @property
    def label(self) -> str:
        """The row in the paper's notation: dt=1/30, alpha=30 %."""
        text = self.name.replace("-alpha", ", alpha").replace("1-", "1/")
        return f"{text} %" if "alpha" in text else text

    @property
    def overrides(self) -> tuple[str, ...]:
        """Scenario overrides of this row."""
        return (
            f"controller.horizon_s={self.horizon_s}",
            f"controller.dt_s={self.dt_s!r}",
            f"controller.falloff={self.falloff}",
        )


ROWS = (
    PaperRow("baseline", 3.0, 0.1, 0.0, 1.64e-2, 3.94e-3),
    PaperRow("T=0.5", 0.5, 0.1, 0.0, 64.8e-2, 229e-3, failed=1),
    PaperRow("T=10", 10.0, 0.1, 0.0, 126e-2, 943e-3, failed=2),
    PaperRow("dt=1-5", 3.0, 0.2, 0.0, 1.73e-2, 4.87e-3),
    PaperRow("dt=1-30", 3.0, 1 / 30, 0.0, 1.42e-2, 3.89e-3),
    PaperRow("alpha=10", 3.0, 0.1, 0.1, 1.65e-2, 4.09e-3),
    PaperRow("alpha=30", 3.0, 0.1, 0.3, 1.69e-2, 4.07e-3),
    PaperRow("alpha=60", 3.0, 0.1, 0.6, 1.75e-2, 4.25e-3),
    PaperRow("dt=1-30-alpha=30", 3.0, 1 / 30, 0.3, 1.59e-2, 4.02e-3),
)
BASELINE = ROWS[0]
