# SPDX-License-Identifier: Apache-2.0
"""Migrate older scenario formats: those of logs are converted, files get an error that names the
new key.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

FORMAT = 3
"""Present format of scenario files. Format 1 called thrusters jets, and images pictures. Up to
format 2, odometry and cameras were exact unless the scenario stated errors."""

_RENAMED_KEYS: dict[tuple[str, ...], str] = {
    ("time", "picture_hz"): "image_hz",
    ("chaser", "jet_test_s"): "thruster_test_s",
    ("chaser", "jet_faults_by_command"): "thruster_faults_by_command",
    ("timeline", "*", "jet"): "thruster",
    ("jet_failure", "*", "jet"): "thruster",
    ("jet_failure", "*", "told"): "reported",
    ("jet_failure",): "thruster_failure",
}
"""Path of a key in format 1 (``*``: every element of an array) -> its present name. Parents follow
their children.
"""

_CAMERA_PRIORS = {
    "camera_bias_attitude_deg": "camera_turn_deg",
    "camera_bias_position_m": "camera_shift_m",
    "camera_bias_focal_share": "camera_focal_share",
}
"""Key of ``[estimator]`` in format 2 -> key of ``[navigation]``: sigmas of the cameras' errors that
the estimator assumed.
"""
_CAMERA_ERRORS = {
    "mounting_deg": ("camera_turn_deg", "turn_deg"),
    "mounting_m": ("camera_shift_m", "shift_m"),
    "focal_length_share": ("camera_focal_share", "focal_share"),
    "centre_px": ("camera_centre_px", "centre_px"),
}
"""Key of ``[camera.calibration_error]`` in format 2 -> keys of ``[navigation]`` and of
``[truth.camera]``.
"""

_MOVED_KEYS: dict[tuple[str, ...], str] = {
    ("odometry",): 'navigation; state the grade, too ("exact": all other errors are 0)',
    **{
        ("camera", "calibration_error", old): f"navigation.{new}"
        for old, (new, _) in _CAMERA_ERRORS.items()
    },
    **{("estimator", old): f"navigation.{new}" for old, new in _CAMERA_PRIORS.items()},
}
"""Path of a key in format 2 -> its present path."""

_REMOVED_KEYS: dict[tuple[str, ...], tuple[Any, str]] = {
    ("camera", "renderer"): ("exact", "PyBullet's renderer is not a part of chaserdock any more"),
    ("chaser", "modulation", "modulator"): (
        "pwm",
        "the Schmitt trigger was removed: with it errors were ten times larger, and propellant "
        "three times",
    ),
    ("chaser", "modulation", "carry_over"): (
        True,
        "impulse that a period cannot give is always added to the next one",
    ),
    ("docking", "clearance_m"): (
        0.45,
        "it is limits.min_distance_chasers_m and 0.1 m now",
    ),
    ("success", "max_collisions"): (0, "any collision is a failure"),
    ("success", "keep_load_limits"): (
        True,
        "the limits that [[docking.ports]] states are always judged",
    ),
    ("plume", "avoid_factor"): (10.0, "thrusters whose plume hits always cost 11 times as much"),
    **{
        path: (value, f"it is {value:g} in every flight now")
        for path, value in {
            ("docking", "overdrive_m"): 0.03,
            ("docking", "approach_timeout_s"): 60.0,
            ("docking", "final_timeout_s"): 30.0,
            ("docking", "contact_timeout_s"): 5.0,
            ("docking", "settle_s"): 2.0,
            ("docking", "pull_s"): 1.0,
            ("docking", "verify_position_m"): 0.005,
            ("docking", "verify_angle_deg"): 0.5,
            ("detumble", "response_s"): 0.5,
            ("detumble", "identification", "duration_s"): 10.0,
            ("chaser", "modulation", "resolution_s"): 0.001,
            ("chaser", "modulation", "schmitt_on"): 0.75,
            ("chaser", "modulation", "schmitt_off"): 0.25,
            ("camera", "eclipse_ambient"): 0.05,
            ("plume", "reach_m"): 10.0,
            ("ranging", "bearing_noise_deg"): 0.005,
        }.items()
    },
}
"""Path of a removed key of format 3 -> the value that every flight has now, which is accepted, and
why no other is.
"""


def _holders(
    values: Any, path: tuple[str, ...], at: tuple[str, ...] = ()
) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield every table that holds the last key of ``path``, with that key's path as text."""
    if isinstance(values, dict) and len(path) == 1:
        if path[0] in values:
            yield values, ".".join((*at, path[0]))
    elif isinstance(values, dict):
        yield from _holders(values.get(path[0]), path[1:], (*at, path[0]))
    elif isinstance(values, list | tuple) and path[0] == "*":
        for i, item in enumerate(values):
            yield from _holders(item, path[1:], (*at, str(i)))


def drop_removed_keys(values: dict[str, Any]) -> None:
    """Delete, in place, removed keys that state what every flight does now."""
    for path, (value, _) in _REMOVED_KEYS.items():
        for table, _ in _holders(values, path):
            if table[path[-1]] == value:
                del table[path[-1]]


def old_keys(values: dict[str, Any]) -> list[str]:
    """Return one line per key, or value, of an older version, naming what it is now."""
    lines = []
    for old, new in _RENAMED_KEYS.items():
        for _, path in _holders(values, old):
            lines.append(
                f"{path}: is now called {path.rpartition('.')[0]}.{new}".replace(" .", " ")
            )
    for old, new in _MOVED_KEYS.items():
        lines += [f"{path}: is now called {new}" for _, path in _holders(values, old)]
    for old, (_, reason) in _REMOVED_KEYS.items():
        lines += [f"{path}: {reason}; remove the key" for _, path in _holders(values, old)]
    for table, path in _holders(values, ("fault", "*", "topic")):
        if table["topic"] == "jets":
            lines.append(f"{path}: 'jets' is now called 'thrusters'")
    for table, path in _holders(values, ("estimator", "name")):
        if table["name"] == "mekf":
            lines.append(f"{path}: 'mekf' was removed; 'joint' estimates the chasers, too")
    return lines


def old_format(values: dict[str, Any]) -> list[str]:
    """Return an error line for values that state another format than the present one."""
    stated = values.get("format", FORMAT)
    if stated == FORMAT:
        return []
    if stated in (1, 2):
        lines = old_keys(values)
        if "navigation" not in values and "odometry" not in values:
            lines.append(
                "odometry and cameras are not exact by default any more (navigation.grade = "
                '"exact")'
            )
        changes = "; ".join(lines) or "no key of this file has another name"
        return [
            f"format: {stated} is not supported any more; set format = {FORMAT} and change: "
            f"{changes}"
        ]
    return [
        f"format: must be {FORMAT}, the format that this version of chaserdock reads (got "
        f"{stated!r})"
    ]


def migrated(text: str) -> str:
    """Return a resolved scenario (JSON) in the present format, without removed keys. Text that is
    not JSON is returned unchanged.
    """
    try:
        values = json.loads(text)
    except (json.JSONDecodeError, RecursionError):
        return text
    if not isinstance(values, dict) or values.get("format", 1) not in (1, 2, FORMAT):
        return text
    if values.get("format", 1) == 1:
        _rename_keys(values)
    if values.get("format", 1) != FORMAT:
        _state_navigation(values)
    elif not any(True for path in _REMOVED_KEYS for _ in _holders(values, path)):
        return text
    for path in _REMOVED_KEYS:
        for table, _ in _holders(values, path):
            del table[path[-1]]
    return json.dumps({**values, "format": FORMAT})


def _rename_keys(values: dict[str, Any]) -> None:
    """Migrate from format 1 to 2, in place."""
    for old, new in _RENAMED_KEYS.items():
        for table, _ in _holders(values, old):
            table[new] = table.pop(old[-1])
    for fault, _ in _holders(values, ("fault", "*", "topic")):
        if fault["topic"] == "jets":
            fault["topic"] = "thrusters"


def _state_navigation(values: dict[str, Any]) -> None:
    """Migrate from format 2 to 3, in place: exact navigation with the errors that the scenario
    states.

    The camera's figures are those that the estimator assumed, so that it replays as it flew; errors
    beyond are ``[truth]``.
    """
    navigation: dict[str, Any] = {"grade": "exact"}
    navigation |= {key: value for key, value in _table(values, "odometry").items() if value}
    if "attitude_noise_deg" in navigation:
        navigation["attitude_roll_noise_deg"] = navigation["attitude_noise_deg"]
    camera = values.get("camera")
    errors = _table(camera, "calibration_error") if isinstance(camera, dict) else {}
    if errors.get("centre_px"):
        navigation["camera_centre_px"] = errors["centre_px"]
    estimator = values.get("estimator")
    for old, new in _CAMERA_PRIORS.items():
        if isinstance(estimator, dict) and (prior := estimator.pop(old, 0.0)):
            navigation[new] = prior
    unknown: dict[str, float] = {}
    for old, (new, hidden) in _CAMERA_ERRORS.items():
        if new != "camera_centre_px" and errors.get(old, 0.0) > (known := navigation.get(new, 0.0)):
            unknown[hidden] = math.sqrt(errors[old] ** 2 - known**2)
    values["navigation"] = navigation
    if unknown:
        values["truth"] = {"camera": unknown}


def _table(values: dict[str, Any], key: str) -> dict[str, Any]:
    """Remove and return a table, empty if there is none."""
    table = values.pop(key, None)
    return table if isinstance(table, dict) else {}
