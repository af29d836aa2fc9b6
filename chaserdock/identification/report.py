# SPDX-License-Identifier: Apache-2.0
"""Text of an identification: a table, what the run does not tell, and lines for the scenario."""

from __future__ import annotations

from typing import Any

import numpy as np

from chaserdock.toml_text import toml_value

from .fit import IdentifiedQuantity, RobotIdentification

_DIGITS = 6
"""Significant digits of pasted values: beyond any accuracy of a run."""
_LOUD = 1.3
"""Measured over stated noise of the odometry that is remarked on: what a filter that trusts the
stated one notices.
"""


def identification_lines(found: RobotIdentification) -> list[str]:
    """Return the lines of the text: table, remarks, TOML."""
    robot = found.robot
    lines = [
        f"chaser {robot.chaser}: {robot.free_s:.1f} s in which only its actuators moved it",
        f"{'':22}{'scenario':>12}{'this run':>12}{'+-':>10}{'difference':>12}{'sigmas':>9}",
    ]
    known = [q for q in found.quantities if q.known]
    for q in known:
        lines.append(
            f"{_label(q):22}{q.stated:12.5g}{q.value:12.5g}{q.sigma:10.2g}"
            f"{q.value - q.stated:+12.3g}{q.off_sigmas:+9.1f}"
        )
    if missing := [q.name for q in found.quantities if not q.known]:
        lines.append(f"not observable in this run: {', '.join(missing)}")
    lines += [*_remarks(found), "", *_toml(found)]
    return lines


def identification_values(found: RobotIdentification) -> dict[str, Any]:
    """Return the identification as plain values for JSON: quantities by name, in SI units."""
    return {
        "chaser": found.robot.chaser,
        "free_s": found.robot.free_s,
        "mass_weighed": found.weighed,
        "quantities": {
            q.name: {
                "unit": q.unit,
                "stated": q.stated,
                "value": q.value if q.known else None,
                "sigma": q.sigma if q.known else None,
            }
            for q in found.quantities
        },
        "scatter_share": found.scatter_share,
        "residual_correlation": found.correlation,
    }


def _label(q: IdentifiedQuantity) -> str:
    return f"{q.name}, {q.unit}" if q.unit else q.name


def _remarks(found: RobotIdentification) -> list[str]:
    thrusters = found.robot.scenario.chaser.actuation == "thrusters"
    out: list[str] = []
    if not found.weighed:
        what = "the mean thrust of these thrusters is" if thrusters else "force and torque are"
        out.append(
            f"scale: {what} taken as stated; 1 % more is 1 % more mass and inertia. Weigh the "
            "robot and give --mass to have it measured."
        )
    if thrusters:
        out.append(f"scatter of a thruster's impulse: {100.0 * found.scatter_share:.0f} %")
    names = ("position", "velocity", "attitude", "rate")
    for name, ratio in zip(names, found.noise_ratio, strict=True):
        if ratio > _LOUD or ratio < 1.0 / _LOUD:
            out.append(f"odometry: noise of the {name} is {ratio:.2f} of the stated one")
    if found.disturbed:
        out.append(
            f"residuals are correlated ({found.correlation:+.2f}): something else moves the robot, "
            "or it does not do as told; standard deviations are too small"
        )
    return out


def _toml(found: RobotIdentification) -> list[str]:
    """Return the scenario's keys with the identified values, ready to paste."""
    body = found.robot.scenario.chaser
    values = {q.name: _rounded(q.value) for q in found.quantities if q.known}
    lines: list[str] = []
    if found.weighed or "mass" in values:
        lines.append(f"mass_kg = {_rounded(found.mass_kg)}")
    moments = [values.get(f"I{a}{a}", i) for a, i in zip("xyz", body.inertia, strict=True)]
    if any(f"I{a}{a}" in values for a in "xyz") and _is_body(np.diag(moments)):
        lines.append(f"inertia_kg_m2 = {toml_value(moments)}")
    if any(f"thruster {k}" in values for k in range(len(body.thrusters))):
        lines.append("thrusters = [")
        for k, thruster in enumerate(body.thrusters):
            keys = thruster.model_dump() | {
                "thrust_N": values.get(f"thruster {k}", thruster.thrust_N)
            }
            inner = ", ".join(f"{key} = {toml_value(value)}" for key, value in keys.items())
            lines.append(f"    {{ {inner} }},")
        lines.append("]")
    if lines:
        lines.insert(0, "[chaser]")
    if true := _for_the_twin(values, moments):
        lines += ["", "[[truth.values]]  # for the simulation twin"]
        lines.append(f"chaser = {found.robot.chaser}")
        lines += [f"{key} = {toml_value(value)}" for key, value in true.items()]
    if (delay := values.get("delay", 0.0)) > 0.0:
        lines += ["", "[truth.chaser]  # for the simulation twin", f"delay_s = {delay}"]
    return lines


def _for_the_twin(values: dict[str, float], moments: list[float]) -> dict[str, Any]:
    """Return what flight software does not know of a robot: for ``[[truth.values]]``."""
    out: dict[str, Any] = {}
    for key, name in (
        ("centre_of_mass_m", "centre"),
        ("force_N", "force"),
        ("torque_N_m", "torque"),
    ):
        found = [values.get(f"{name} {axis}", 0.0) for axis in "xyz"]
        if any(found):
            out[key] = found
    products = [values.get(f"I{pair}", 0.0) for pair in ("xy", "xz", "yz")]
    if any(products) and _is_body(_tensor(moments, products)):
        out["inertia_kg_m2"] = [*moments, *products]
    return out


def _is_body(inertia: Any) -> bool:
    """Return whether a body can have an inertia tensor (3, 3): no moment exceeds the other two."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and 2.0 * moments[2] <= moments.sum())


def _tensor(moments: list[float], products: list[float]) -> Any:
    xy, xz, yz = products
    return np.diag(moments) + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
