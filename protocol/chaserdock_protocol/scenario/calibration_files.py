# SPDX-License-Identifier: Apache-2.0
"""Read camera calibration files of other tools: OpenCV (samples and interactive tool; YAML, XML,
JSON), ROS (``camera_info`` files, and the message as text) and Kalibr (camchain).

What a file says and a camera cannot have (skew, another lens model, a region of the sensor) is
refused, never dropped.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from chaserdock_models.camera import focal_and_centre
from chaserdock_models.lenses import COEFFICIENTS, LensModel, one_of

from .errors import ScenarioError

_MOST_BYTES = 16 * 1024 * 1024
"""Largest file: OpenCV's with the corners of a thousand images has about one."""
_WIDTH = ("image_width", "width")
_HEIGHT = ("image_height", "height")
_SIZE = ("cameraResolution", "image_size", "resolution")
_MATRIX = ("camera_matrix", "K")
_COEFFICIENTS = (
    "distortion_coefficients", "dist_coeffs", "distortion_coeffs", "distortion_coefficents", "D"
)  # fmt: skip
"""Names of keys, in any case, with and without underscores; the fourth is a common misspelling."""
_MODELS: dict[str, tuple[LensModel, tuple[int, ...]]] = {
    "plumb_bob": ("perspective", (0, 4, 5)),
    "rational_polynomial": ("perspective", (5, 8, 12, 14)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "kannala_brandt": ("equidistant", (4,)),
}
"""Distortion models by ROS' name, and the name that others give them: numbers of coefficients."""
_KALIBR: dict[str, tuple[LensModel, tuple[int, ...]]] = {
    "radtan": ("perspective", (4,)),
    "equidistant": ("equidistant", (4,)),
    "equi": ("equidistant", (4,)),
    "none": ("perspective", (0,)),
}

CalibrationValues = dict[str, Any]


class _Bad(Exception):
    """What is wrong with a file, without its name."""


def read_calibration(path: Path) -> CalibrationValues:
    """Return ``camera.intrinsics`` from a calibration file; ``camchain.yaml#cam1`` names one camera
    of several. Raises ScenarioError.
    """
    camera = None
    if not path.exists() and "#" in path.name:
        name, _, camera = path.name.rpartition("#")
        path = path.with_name(name)
    if not path.is_file():
        raise ScenarioError(f"{path}: no such calibration file")
    try:
        values = _parsed(path)
        if camera is not None or _is_camchain(values):
            return _from_camchain(values, camera)
        return _from_matrix(values)
    except _Bad as error:
        raise ScenarioError(f"{path}: {error}") from None


# -- Formats ---------------------------------------------------------------------------------------


def _parsed(path: Path) -> CalibrationValues:
    """Return the content of a YAML, XML or JSON file."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise _Bad(f"not a calibration file: larger than {_MOST_BYTES // 1024**2} MiB")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise _Bad(f"cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise _Bad(f"not a calibration file (YAML, XML or JSON): not UTF-8 text: {error}") from None
    text = text.lstrip()
    try:
        if text.startswith("<"):
            values = _from_xml(ElementTree.fromstring(text))
        elif text.startswith("{"):
            # OpenCV writes comments.
            values = json.loads(re.sub(r"^\s*//.*$", "", text, flags=re.MULTILINE))
        else:
            values = _from_yaml(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise _Bad(f"not a calibration file (YAML, XML or JSON): {reason}") from None
    if not isinstance(values, dict) or not values:
        raise _Bad("not a calibration file (YAML, XML or JSON): has no keys")
    return {str(key): value for key, value in values.items()}


def _from_yaml(text: str) -> Any:
    """Parse YAML, also with the header and the tags of OpenCV. Raises ValueError."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Reads OpenCV's matrices as tables."""

        def construct_matrix(self, node: yaml.MappingNode) -> dict[Any, Any]:
            """Return the table of a matrix."""
            return self.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", Loader.construct_matrix)
    if text.startswith("%YAML"):  # OpenCV's header is not YAML's
        text = text.partition("\n")[2]
    try:
        return next(iter(yaml.load_all(text, Loader)), None)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


def _from_xml(element: ElementTree.Element) -> Any:
    """Return the tables, lists and texts of OpenCV's XML."""
    if len(element):
        return {child.tag: _from_xml(child) for child in element}
    words = (element.text or "").split()
    return words if element.tag in ("data", *_SIZE) else " ".join(words).strip('"')


# -- Keys ------------------------------------------------------------------------------------------


def _plain(key: str) -> str:
    return key.replace("_", "").lower()


def _found(values: CalibrationValues, names: Sequence[str]) -> tuple[str, Any] | None:
    """Return the key of a file that has one of these names, and its value."""
    plain = {_plain(key): key for key in reversed(values)}
    for name in names:
        if (key := plain.get(_plain(name))) is not None:
            return key, values[key]
    return None


def _needed(values: CalibrationValues, what: str, *names: Sequence[str]) -> tuple[str, Any]:
    for some in names:
        if (found := _found(values, some)) is not None:
            return found
    known = " or ".join(some[0] for some in names)
    raise _Bad(f"has no {what} ({known}); it has {', '.join(values)}")


def _number(key: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise _Bad(f"{key} must have finite numbers (got {value!r})")
    return number


def _numbers(key: str, value: Any) -> list[float]:
    """Return the numbers of a matrix: of OpenCV and ROS (rows, cols, data), or of a list."""
    rows = cols = None
    if isinstance(value, dict):
        if "data" not in value:
            raise _Bad(f"{key} must have data; it has {', '.join(map(str, value))}")
        rows, cols = value.get("rows"), value.get("cols")
        value = value["data"]
    if isinstance(value, str):
        value = value.split()
    if value is None:
        value = []
    if not isinstance(value, list):
        raise _Bad(f"{key} must be a list of numbers (got {value!r})")
    flat = [x for row in value for x in (row if isinstance(row, list) else [row])]
    if rows is not None and cols is not None:
        count = _number(f"{key}.rows", rows) * _number(f"{key}.cols", cols)
        if count != len(flat):
            raise _Bad(f"{key} has {len(flat)} numbers where {rows} x {cols} are stated")
    return [_number(key, x) for x in flat]


def _size(values: CalibrationValues) -> tuple[int, int]:
    found = _found(values, _SIZE)
    if found is not None and _found(values, _WIDTH) is None:
        key, value = found
        sides = _numbers(key, value)
        if len(sides) != 2:
            raise _Bad(f"{key} must be width and height (got {value!r})")
    else:
        sides = []
        for what, names in (("width of the image", _WIDTH), ("height of the image", _HEIGHT)):
            key, value = _needed(values, what, names, _SIZE)
            sides.append(_number(key, value))
    width, height = sides
    if not (width >= 1 and height >= 1 and width == int(width) and height == int(height)):
        raise _Bad(f"the image must be of whole, positive size (got {width:g} x {height:g})")
    return int(width), int(height)


# -- OpenCV and ROS --------------------------------------------------------------------------------


def _from_matrix(values: CalibrationValues) -> CalibrationValues:
    """Return intrinsics from a file with a camera matrix: of OpenCV or of ROS."""
    key, value = _needed(values, "camera matrix", _MATRIX)
    matrix = _numbers(key, value)
    if len(matrix) != 9:
        raise _Bad(f"{key} must be a 3 x 3 matrix (got {len(matrix)} numbers)")
    width, height = _size(values)
    try:
        lens = focal_and_centre(matrix)
    except ValueError as error:
        raise _Bad(f"{key}: {error}") from None
    _refuse_parts_of_images(values)
    found = _found(values, _COEFFICIENTS)
    key, coefficients = (found[0], _numbers(*found)) if found else ("distortion_coefficients", [])
    name, model, counts = _model(values)
    if len(coefficients) not in counts:
        raise _Bad(f"{key}: {name} takes {one_of(counts)} coefficients, not {len(coefficients)}")
    return _intrinsics(width, height, lens, model, coefficients)


def _model(values: CalibrationValues) -> tuple[str, LensModel, tuple[int, ...]]:
    """Return the lens model of a file, by its name there, and its numbers of coefficients."""
    found = _found(values, ("fisheye_model",))
    if found is not None and _number(*found):
        return "a fisheye_model", "equidistant", COEFFICIENTS["equidistant"]
    # Early files of ROS call it camera_model.
    found = _found(values, ("distortion_model", "camera_model"))
    name = "" if found is None or found[1] is None else str(found[1])
    if found is None or not name:
        return "the perspective lens", "perspective", COEFFICIENTS["perspective"]
    if name.lower() not in _MODELS:
        raise _Bad(f"{found[0]} {name} is not known; known: {', '.join(_MODELS)}")
    return name, *_MODELS[name.lower()]


def _refuse_parts_of_images(values: CalibrationValues) -> None:
    """Refuse a message of ROS whose image is not the calibrated one."""
    for key in ("binning_x", "binning_y"):
        if (found := _found(values, (key,))) is not None and _number(*found) > 1.0:
            raise _Bad(f"{found[0]} must be 0 or 1: calibrate the images as they are taken")
    region = values.get("roi")
    if isinstance(region, dict) and any(
        _number(f"roi.{key}", region.get(key, 0)) for key in ("x_offset", "y_offset")
    ):
        raise _Bad("roi must begin at 0, 0: calibrate the images as they are taken")


# -- Kalibr ----------------------------------------------------------------------------------------


def _is_camchain(values: CalibrationValues) -> bool:
    return any(re.fullmatch(r"cam\d+", key) for key in values) or "intrinsics" in values


def _from_camchain(values: CalibrationValues, camera: str | None) -> CalibrationValues:
    cameras = {k: v for k, v in values.items() if isinstance(v, dict) and "intrinsics" in v}
    if "intrinsics" in values and camera is None:
        return _from_kalibr("", values)
    if camera is None and len(cameras) > 1:
        names = ", ".join(cameras)
        raise _Bad(f"has several cameras ({names}); name one, as in camchain.yaml#{names[:4]}")
    camera = next(iter(cameras), "") if camera is None else camera
    if camera not in cameras:
        raise _Bad(f"has no camera {camera!r}; it has {', '.join(cameras) or ', '.join(values)}")
    return _from_kalibr(f"{camera}.", cameras[camera])


def _from_kalibr(place: str, values: CalibrationValues) -> CalibrationValues:
    if (model := str(values.get("camera_model"))) != "pinhole":
        raise _Bad(f"{place}camera_model {model} is not known; known: pinhole")
    name = str(values.get("distortion_model"))
    if name not in _KALIBR:
        raise _Bad(f"{place}distortion_model {name} is not known; known: {', '.join(_KALIBR)}")
    lens = _numbers(f"{place}intrinsics", values["intrinsics"])
    if len(lens) != 4:
        raise _Bad(f"{place}intrinsics must be fu, fv, pu, pv (got {len(lens)} numbers)")
    coefficients = _numbers(f"{place}distortion_coeffs", values.get("distortion_coeffs", []))
    kind, counts = _KALIBR[name]
    if len(coefficients) not in counts:
        raise _Bad(
            f"{place}distortion_coeffs: {name} takes {one_of(counts)} coefficients, not "
            f"{len(coefficients)}"
        )
    width, height = _size(values)
    fx, fy, cx, cy = lens
    return _intrinsics(width, height, (fx, fy, cx, cy), kind, coefficients)


# --------------------------------------------------------------------------------------------------


def _intrinsics(
    width: int,
    height: int,
    lens: tuple[float, float, float, float],
    model: LensModel,
    coefficients: list[float],
) -> CalibrationValues:
    fx, fy, cx, cy = lens
    if not (fx > 0.0 and fy > 0.0):
        raise _Bad(f"focal lengths must be positive (got {fx:g}, {fy:g}): is it calibrated?")
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise _Bad(
            f"the principal point ({cx:g}, {cy:g}) is not in the image of {width} x {height}: "
            "the matrix belongs to images of another size"
        )
    if model == "perspective":  # the shortest form: OpenCV writes zeros for what it did not fit
        used = max((k + 1 for k, value in enumerate(coefficients) if value), default=0)
        counts = [n for n in COEFFICIENTS[model] if max(used, 4) <= n <= len(coefficients)]
        coefficients = coefficients[: min(counts)] if counts else coefficients
    return {
        "width_px": width,
        "height_px": height,
        "fx_px": fx,
        "fy_px": fy,
        "cx_px": cx,
        "cy_px": cy,
        "distortion": coefficients,
        "lens_model": model,
    }
