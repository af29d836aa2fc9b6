# SPDX-License-Identifier: Apache-2.0
"""Find and read a dataset: a folder that `export_dataset` wrote, or one in the layout of SPEED+ or
BOP.
"""

from __future__ import annotations

import json
from pathlib import Path

from chaserdock_protocol.scenario import FlightScenario, flight_scenario_from_json

from .bop import read_bop
from .export import DESCRIPTION, FOLDERS
from .json_files import read_object
from .speed_plus import read_speed_plus
from .types import DatasetError, LabelledDataset


def read_dataset(folder: Path) -> tuple[LabelledDataset, FlightScenario | None]:
    """Return a dataset, and what its flight software knows; None for a dataset from elsewhere.
    Raises DatasetError.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder")
    root, own = folder, folder / DESCRIPTION
    if own.is_file():
        folder = next(
            (folder / name for name in FOLDERS.values() if (folder / name).is_dir()), folder
        )
    elif folder.name in FOLDERS.values() and (root.parent / DESCRIPTION).is_file():
        own = root.parent / DESCRIPTION
    if (folder / "synthetic").is_dir():
        dataset = read_speed_plus(folder)
    elif any((folder / name).is_dir() for name in ("train", "val", "test")):
        dataset = read_bop(folder)
    else:
        raise DatasetError(
            f"{root}: no dataset; expected a folder of `chaserdock dataset`, or one with "
            "camera.json and synthetic/ (SPEED+) "
            "or train/, val/ or test/ (BOP)"
        )
    return dataset, _flight(own) if own.is_file() else None


def _flight(file: Path) -> FlightScenario:
    values = read_object(file)
    if "flight_scenario" not in values:
        raise DatasetError(
            f"{file}: flight_scenario is missing; it is not the description of a dataset"
        )
    return flight_scenario_from_json(json.dumps(values["flight_scenario"]), str(file))
