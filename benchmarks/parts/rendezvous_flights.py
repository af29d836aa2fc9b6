# SPDX-License-Identifier: Apache-2.0
"""Whole rendezvous from 200 m to the verified latch in one process, with statistical perception,
and aborts at random moments of them.

Figures: time, change of velocity, tracking at the hold points, step of the estimate at the first
markers, and contact.
"""

from __future__ import annotations

import math
import time
from argparse import ArgumentParser
from functools import partial

from common import Figures, Group, Options, described, seeds_of
from flights import load_shipped
from flights.abort_study import study
from flights.rendezvous import last_leg, leg, rendezvous

from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import RenderedImages


def fly(name: str, seed: int, options: Options) -> Figures:
    """Fly one scenario with one seed; return its figures."""
    scenario = load_shipped(name, f"seed={seed}", *options.set)
    if options.leg is not None:
        scenario = leg(scenario, options.leg)
    elif options.quick:
        scenario = last_leg(scenario)
    begin_s, shown = time.process_time(), [0]

    def report(record: TickRecord, flight: InProcessMission) -> None:
        if not options.events:
            return
        for at_s, level, text in flight.events[shown[0] :]:
            print(f"    {at_s:.1f} s {level}: {text}", flush=True)
        shown[0] = len(flight.events)

    out = rendezvous(scenario, RenderedImages(scenario), report)
    begin = f"{name}_{seed}_"
    figures = {
        f"{begin}verified": float(out.verified_s is not None),
        f"{begin}verified_s": math.nan if out.verified_s is None else out.verified_s,
        f"{begin}delta_v_m_s": out.delta_v_m_s,
        f"{begin}propellant_kg": out.propellant_kg,
        f"{begin}keep_out_margin_m": out.keep_out_margin_m,
        f"{begin}max_closing_m_s": out.max_closing_m_s,
        f"{begin}contact_lateral_m": out.contact_lateral_m,
        f"{begin}contact_angle_deg": out.contact_angle_deg,
        f"{begin}contact_closing_m_s": out.contact_closing_m_s,
        f"{begin}collisions": len(out.contacts),
        f"{begin}warnings": sum(level != "info" for _, level, _ in out.events),
        f"{begin}processor_s": time.process_time() - begin_s,
    }
    for hold in out.holds:
        at = f"{begin}hold_{round(hold.range_m)}m_"
        figures |= {
            f"{at}position_rms_m": hold.position_rms_m,
            f"{at}angle_max_deg": hold.angle_max_deg,
            f"{at}estimate_rms_m": hold.estimate_rms_m,
        }
    if (over := out.hand_over) is not None:
        figures |= {
            f"{begin}hand_over_range_m": over.range_m,
            f"{begin}hand_over_step_m": over.step_m,
            f"{begin}hand_over_step_deg": over.step_deg,
            f"{begin}hand_over_step_sigmas": over.step_sigmas,
            f"{begin}hand_over_error_before_sigmas": over.error_sigmas,
        }
    return figures


def fly_seeds(name: str, options: Options) -> Figures:
    """Fly a scenario with one seed (``--flights``), with ``--quick`` only its last leg."""
    figures = Figures()
    for seed in seeds_of(options, 1, 1):
        figures |= fly(name, seed, options)
    return figures


def aborts(options: Options) -> Figures:
    """Abort at 1,000 random moments of ``v-bar`` (``--abort-scenario``): those that enter the
    keep-out within two orbits.

    The guidance of the controller chooses each abort; its burn and two orbits of coast are those of
    the nonlinear relative motion with J2, under random disturbances of the stated size.
    """
    count = options.flights or (50 if options.quick else 1000)
    scenario = load_shipped(options.abort_scenario, *options.set)
    found = study(scenario, count, seed=options.first)
    return {
        "aborts": found.aborts,
        "certified": found.certified,
        "entered_keep_out": found.entered,
        "nearest_m": found.nearest_m,
        "mean_delta_v_m_s": found.mean_delta_v_m_s,
        "max_delta_v_m_s": found.max_delta_v_m_s,
        "profile_s": found.profile_s,
    }


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--leg",
        type=int,
        metavar="N",
        help="only from the place before command N of the timeline to the next",
    )
    parser.add_argument("--events", action="store_true", help="print the controller's events")
    parser.add_argument("--abort-scenario", default="v-bar", metavar="NAME", help="of aborts")


SCENARIOS = ("v-bar", "r-bar")
GROUP = Group(
    {
        **{
            name: described(partial(fly_seeds, name), f"Fly {name} to the verified latch.")
            for name in SCENARIOS
        },
        "aborts": aborts,
    },
    ("flights", "first", "set"),
    add_options,
)
