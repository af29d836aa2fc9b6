# SPDX-License-Identifier: Apache-2.0
"""Which success criteria of a scenario its flight can be judged by."""

from __future__ import annotations

from chaserdock_protocol.scenario import Scenario


def judged_criteria(scenario: Scenario) -> tuple[Scenario, list[str]]:
    """Return the scenario with the success criteria that its duration allows to judge, and a line for each other one.

    A scenario that is shortened by an override can end before the part of the flight that a criterion is about: before
    ``settling_s`` (tracking and estimation errors), or before the time line commands the approach or the ``goto`` of a
    chaser (``docked``, ``latched``, ``reached``). Such criteria are neither met nor violated.
    """
    success, changes, skipped = scenario.success, {}, []
    end_s = min(scenario.steady_until_s or scenario.duration_s, scenario.duration_s)
    for name, from_s, until_s in (
        ("steady_position_rms_m", scenario.settling_s, end_s),
        ("steady_orientation_rms_deg", scenario.settling_s, end_s),
        ("max_estimate_position_m", scenario.settling_s, scenario.duration_s),
        ("max_estimate_orientation_deg", scenario.settling_s, scenario.duration_s),
    ):
        if getattr(success, name) is not None and from_s >= until_s:
            changes[name] = None
            skipped.append(f"success.{name}: the flight ends at {until_s:g} s, settling_s is {from_s:g} s")
    for name, command in (("docked", "approach"), ("latched", "approach"), ("reached", "goto")):
        late = {
            i: first_s
            for i in getattr(success, name)
            if (first_s := _first_command_s(scenario, command, i)) is not None
            and first_s >= scenario.duration_s
        }
        if late:
            changes[name] = tuple(i for i in getattr(success, name) if i not in late)
            skipped += [
                f"success.{name}, chaser {i}: the flight ends at {scenario.duration_s:g} s, "
                f"its {command} is at {first_s:g} s"
                for i, first_s in late.items()
            ]
    return scenario.model_copy(update={"success": success.model_copy(update=changes)}), skipped


def _first_command_s(scenario: Scenario, command: str, chaser: int) -> float | None:
    """Return the time of the first such command of the time line to a chaser, or None."""
    return min(
        (e.at_s for e in scenario.timeline if e.command == command and chaser in e.chasers), default=None
    )
