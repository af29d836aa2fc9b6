# SPDX-License-Identifier: Apache-2.0
"""Published rendezvous and docking tasks by their own criteria: AFRL's docking of three deputies,
and the spacecraft rendezvous of ARCH-COMP.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from common import Figures, Group, Options, described, seeds_of
from flights.published_tasks import (
    AfrlOutcome,
    ArchOutcome,
    afrl_docking,
    afrl_starts,
    arch_comp,
    arch_start,
    fly_scenario,
)

QUICK_S = 300.0
"""Duration of a scenario with ``--quick``."""


def afrl(options: Options) -> Figures:
    """Dock three deputies from 100 to 150 m under the speed limit by a law of its own, 1,000
    episodes.
    """
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


def arch(options: Options) -> Figures:
    """Fly 10^5 samples of ARCH-COMP's initial set without an abort (SRNA01) and with one at a
    random time within 240 minutes (SRA08), by the task's controller.
    """
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


def scenario(name: str, draw: Callable[[int], tuple[str, ...]], options: Options) -> Figures:
    """Fly a shipped scenario with the starts of each seed; return how many flights meet all
    criteria, and the least margins. With ``--quick`` only its begin, which cannot arrive.
    """
    flights = seeds_of(options, 5, 1)
    length = (f"duration_s={QUICK_S}",) if options.quick else ()
    passed, least = 0, {"speed_margin_m_s": 1e9, "abort_clear_m": 1e9}
    latest_s, cone_rad, apart_m = 0.0, 0.0, 1e9
    for seed in flights:
        found = fly_scenario(name, (*draw(seed), *length))
        passed += found["success"]
        apart_m = min(apart_m, found["min_distance_chasers_m"] or 1e9)
        for i, chaser in found["chasers"].items():
            figures = chaser["rendezvous"]
            least = {k: min(v, v if figures[k] is None else figures[k]) for k, v in least.items()}
            latest_s, cone_rad = (
                max(a, figures[k] or 0.0)
                for a, k in ((latest_s, "arrived_s"), (cone_rad, "cone_angle_rad"))
            )
            print(f"    seed {seed}, chaser {i}: {figures}", flush=True)
        for failure in found["failures"]:
            print(f"    seed {seed}: not met: {failure}", flush=True)
    figures = {"flights": len(flights), "passed": passed, **least}
    figures |= {
        "latest_arrival_s": latest_s,
        "cone_angle_rad": cone_rad,
        "chasers_apart_m": apart_m,
    }
    return {
        f"{name}_{key}": value
        for key, value in figures.items()
        if value not in (0.0, 1e9) or key == "passed"
    }


GROUP = Group(
    {
        "afrl": afrl,
        "arch": arch,
        "afrl-scenario": described(
            partial(scenario, "afrl-docking", afrl_starts),
            "Fly afrl-docking whole, as simulate does, with random starts of five seeds.",
        ),
        "arch-scenario": described(
            partial(scenario, "arch-comp-rendezvous", arch_start),
            "Fly arch-comp-rendezvous so, every second seed with an abort.",
        ),
    },
    ("flights", "first"),
)
