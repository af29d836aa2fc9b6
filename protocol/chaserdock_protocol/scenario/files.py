# SPDX-License-Identifier: Apache-2.0
"""Read scenario files, and the target and calibration files that they name.

Their content becomes part of the scenario, because the world sends it to processes that do not have
these files.
"""

from __future__ import annotations

import re
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

from chaserdock_models.camera import Camera
from chaserdock_models.satellites import satellite_names
from chaserdock_models.targets import TargetModel, target_names
from pydantic import TypeAdapter, ValidationError

from .bodies import FlightTarget
from .calibration_files import read_calibration
from .camera import Intrinsics
from .errors import ScenarioError, invalid
from .fields import Positive, Vector
from .surface import SUFFIXES
from .target import Geometry

_SCALE: TypeAdapter[float] = TypeAdapter(Positive)
_ORIGIN: TypeAdapter[Vector] = TypeAdapter(Vector)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file. Raises ScenarioError."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not UTF-8 text: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise ScenarioError(f"{path}: nested too deeply") from None


def resolve_files(values: dict[str, Any], folder: Path) -> None:
    """Replace the files that a scenario names by their content, in place; paths are relative to
    ``folder``.

    Raises ScenarioError for files that cannot be read or are not valid.
    """
    target, camera = values.get("target"), values.get("camera")
    if isinstance(target, dict):
        model = target.get("model")
        if isinstance(model, str) and model.endswith(".toml"):
            path = folder / model
            target["geometry"] = _geometry_values(path)
            target["model"] = path.stem
        elif isinstance(model, str) and Path(model).suffix.lower() in SUFFIXES:
            target["geometry"] = {"mesh": model}
            _read_mesh(target["geometry"], folder)
            target["model"] = _name_of(Path(model))
        elif isinstance(target.get("geometry"), dict):
            _read_mesh(target["geometry"], folder)
    if isinstance(camera, dict) and isinstance(camera.get("calibration"), str):
        camera["intrinsics"] = read_calibration(folder / camera.pop("calibration"))


def _geometry_values(path: Path) -> dict[str, Any]:
    values = read_toml(path)
    try:
        Geometry.model_validate(values)
    except ValidationError as error:
        raise invalid(error, Geometry, path) from None
    _read_mesh(values, path.parent)
    return values


def _name_of(path: Path) -> str:
    """Return a name for a target from that of its mesh file."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", path.stem).lstrip("._-")[:60] or "mesh"
    return f"{name}_mesh" if name in target_names() else name


def _read_mesh(geometry: dict[str, Any], folder: Path) -> None:
    """Put the content of the mesh file that a geometry names into it, in place, unless it is there.
    Raises ScenarioError.
    """
    mesh = geometry.get("mesh")
    if not isinstance(mesh, str) or not mesh or mesh in satellite_names():
        if isinstance(mesh, str):
            geometry.pop("surface", None)
        return
    path = (folder / mesh).resolve()
    scale, origin = geometry.get("mesh_scale", 1.0), geometry.get("mesh_origin_m", (0.0, 0.0, 0.0))
    try:
        scale, origin = _SCALE.validate_python(scale), _ORIGIN.validate_python(tuple(origin))
    except (ValidationError, TypeError):
        return  # reported by the schema
    held = geometry.get("surface")
    if isinstance(held, dict) and (
        held.get("file"),
        held.get("scale"),
        tuple(held.get("origin_m", ())),
    ) == (
        str(path),
        scale,
        origin,
    ):
        return
    geometry["mesh"] = str(path)
    geometry["surface"] = _surface_values(
        path, path.stat().st_mtime_ns if path.is_file() else 0, scale, origin
    )


@lru_cache(maxsize=4)
def _surface_values(path: Path, changed_ns: int, scale: float, origin_m: Vector) -> dict[str, Any]:
    from .mesh_files import read_surface  # needs trimesh, which is slow to import

    return read_surface(path, scale, origin_m).model_dump(mode="json")


def load_camera(path: Path) -> Camera:
    """Return the camera of a calibration file (`read_calibration`). Raises ScenarioError."""
    try:
        return Intrinsics.model_validate(read_calibration(path)).camera()
    except ValidationError as error:
        raise invalid(error, Intrinsics, path) from None


def find_target(name: str) -> TargetModel:
    """Return the target of a file (``….toml``, a mesh) or of a known name. Raises ScenarioError."""
    return find_flight_target(name).shape()


def find_flight_target(name: str, mesh_scale: float = 1.0) -> FlightTarget:
    """Return what flight software knows of a target: that of a file (``….toml``, or a mesh, with
    the factor from its unit of length to m) or of a known name. Raises ScenarioError.
    """
    values: dict[str, Any]
    if Path(name).suffix.lower() in SUFFIXES:
        values = {"mesh": name, "mesh_scale": mesh_scale}
        _read_mesh(values, Path())
        return FlightTarget(model=_name_of(Path(name)), geometry=Geometry.model_validate(values))
    if name.endswith(".toml"):
        path = Path(name)
        geometry = Geometry.model_validate(_geometry_values(path))
        return FlightTarget(model=_name_of(path), geometry=geometry)
    if name not in target_names():
        raise ScenarioError(
            f"unknown target {name!r}; known: {', '.join(target_names())}, or a file ….toml or "
            "….glb"
        )
    return FlightTarget(model=name)
