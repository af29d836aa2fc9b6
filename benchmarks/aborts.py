# SPDX-License-Identifier: Apache-2.0
"""Aborts at random moments of a rendezvous: ``python benchmarks/aborts.py [--scenario v-bar]
[--aborts 1000] [--quick]``.

The guidance of the controller chooses each abort (controller.md, passive safety); its burn and two
orbits of coast are those of the nonlinear relative motion with J2. Counts those that enter the
keep-out (benchmarks/flights/abort_study.py).
"""

from __future__ import annotations

from common import make_parser, print_figures, write_json
from flights import load_shipped
from flights.abort_study import study


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--scenario", default="v-bar", help="shipped scenario")
    parser.add_argument("--aborts", type=int, default=1000, help="number of aborts")
    options = parser.parse_args()
    found = study(load_shipped(options.scenario), 50 if options.quick else options.aborts, seed=0)
    figures = {
        "aborts": found.aborts,
        "certified": found.certified,
        "entered_keep_out": found.entered,
        "nearest_m": found.nearest_m,
        "mean_delta_v_m_s": found.mean_delta_v_m_s,
        "max_delta_v_m_s": found.max_delta_v_m_s,
        "profile_s": found.profile_s,
    }
    print_figures(figures)
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
