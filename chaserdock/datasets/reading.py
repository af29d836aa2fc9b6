# SPDX-License-Identifier: Apache-2.0
"""Find and read a dataset: a folder that `export_dataset` wrote, or one in the layout of SPEED,
SPEED+ or BOP.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from chaserdock_protocol.scenario import FlightScenario, flight_scenario_from_json

from .bop import domains_of as bop_domains_of
from .bop import read_bop
from .export import DESCRIPTION, FOLDERS
from .json_files import read_object
from .speed_plus import domains_of, is_speed, read_speed, read_speed_plus
from .types import DatasetError, LabelledDataset, Selection

_EVERYTHING = Selection()


def read_dataset(
    folder: Path, wanted: Selection = _EVERYTHING
) -> tuple[LabelledDataset, FlightScenario | None]:
    """Return what is wanted of a dataset, and what its flight software knows; None for a dataset
    from elsewhere.

    The folder of a domain, such as ``speedplus/lightbox`` or ``lm/train_pbr``, selects it. Raises
    DatasetError.
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
    dataset = _read(folder, wanted)
    if dataset is None and wanted.domain is None:
        name = folder.resolve().name
        dataset = _read(folder.resolve().parent, replace(wanted, domain=name), only=name)
    if dataset is None:
        raise DatasetError(
            f"{root}: no dataset; expected a folder of `chaserdock dataset`, or one with "
            "camera.json and synthetic/, lightbox/ or sunlamp/ (SPEED+), train.json and images/ "
            "(SPEED) or train/, val/, test/, train_pbr/ or the like (BOP)"
        )
    return dataset, _flight(own) if own.is_file() else None


def _read(folder: Path, wanted: Selection, only: str | None = None) -> LabelledDataset | None:
    """Return what is wanted of a dataset, None where the folder has no layout that is known;
    ``only``: or not this domain.
    """
    for domains, read in (
        (domains_of(folder), read_speed_plus),
        (bop_domains_of(folder), read_bop),
    ):
        if domains and only in (None, *domains):
            return read(folder, wanted)
    return read_speed(folder, wanted) if only is None and is_speed(folder) else None


def _flight(file: Path) -> FlightScenario:
    values = read_object(file)
    if "flight_scenario" not in values:
        raise DatasetError(
            f"{file}: flight_scenario is missing; it is not the description of a dataset"
        )
    return flight_scenario_from_json(json.dumps(values["flight_scenario"]), str(file))
