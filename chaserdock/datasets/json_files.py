# SPDX-License-Identifier: Apache-2.0
"""JSON files of datasets: written with sorted rows, read with one line per fault."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.output_files import write_atomically

from .types import DatasetError


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write an object, one line per key. Raises OSError."""
    rows = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in values.items()]
    write_atomically(path, "{\n" + ",\n".join(rows) + "\n}\n")


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise DatasetError(f"{path}: not JSON: {error}") from None


def read_object(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file. Raises DatasetError."""
    values = _read(path)
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: must contain an object, not a {type(values).__name__}")
    return values


def read_list(path: Path) -> list[Any]:
    """Return the list of a JSON file. Raises DatasetError."""
    values = _read(path)
    if not isinstance(values, list):
        raise DatasetError(f"{path}: must contain a list, not a {type(values).__name__}")
    return values


def numbers(
    place: Path | str, values: Mapping[str, Any], key: str, shape: tuple[int, ...]
) -> Array:
    """Return ``key`` of an object as finite numbers of ``shape``, from a flat list too. Raises
    DatasetError.
    """
    count = int(np.prod(shape, dtype=np.int64))
    try:
        array = np.asarray(values[key], dtype=float)
    except KeyError:
        raise DatasetError(f"{place}: {key} is missing") from None
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.size != count or not np.isfinite(array).all():
        raise DatasetError(
            f"{place}: {key} must be {count} finite number{'s' if count > 1 else ''}"
        )
    return array.reshape(shape)
