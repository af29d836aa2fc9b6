# SPDX-License-Identifier: Apache-2.0
"""Published rendezvous and docking tasks by their own criteria: ``python benchmarks/published_tasks.py [--quick] [--only PART]``.

``afrl``: three deputies dock from 100 to 150 m under the speed limit, 1,000 episodes. ``arch``: the spacecraft rendezvous of
ARCH-COMP, 10^5 samples of its initial set without an abort (SRNA01) and with one at a random time within 240 minutes (SRA08).
"""

from __future__ import annotations

import argparse

from common import Figures, make_parser, run_parts

from chaserdock.evaluation.published_tasks import AfrlOutcome, ArchOutcome, afrl_docking, arch_comp


def afrl(options: argparse.Namespace) -> Figures:
    found: AfrlOutcome = afrl_docking(100 if options.quick else 1000, seed=0)
    return {
        "afrl_episodes": found.episodes,
        "afrl_docked": found.docked,
        "afrl_too_fast": found.too_fast,
        "afrl_too_near": found.too_near,
        "afrl_late": found.late,
        "afrl_speed_margin_m_s": found.speed_margin_m_s,
        "afrl_apart_m": found.apart_m,
        "afrl_last_docked_s": found.time_s,
        "afrl_delta_v_m_s": found.delta_v_m_s,
    }


def arch(options: argparse.Namespace) -> Figures:
    samples, figures = 1000 if options.quick else 100_000, {}
    for name, abort_min in (("srna01", (1e9, 1e9)), ("sra08", (0.0, 240.0))):
        found: ArchOutcome = arch_comp(samples, 0, abort_min)
        figures |= {
            f"arch_{name}_samples": found.samples,
            f"arch_{name}_attempts": found.attempts,
            f"arch_{name}_violations": found.violations,
            f"arch_{name}_cone_margin_m": found.cone_margin_m,
            f"arch_{name}_speed_margin_m_s": found.speed_margin_m_s,
            f"arch_{name}_clearance_m": found.clearance_m,
        }
    return figures


def main() -> None:
    options = make_parser(__doc__, ("afrl", "arch")).parse_args()
    run_parts(options, {"afrl": lambda: afrl(options), "arch": lambda: arch(options)})


if __name__ == "__main__":
    main()
