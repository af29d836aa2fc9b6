# SPDX-License-Identifier: Apache-2.0
"""Read the options of a device or a source of images, with one line for those that are invalid."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from .devices import DeviceError

_Options = TypeVar("_Options", bound=msgspec.Struct)


def read_options(kind: type[_Options], options: Mapping[str, Any]) -> _Options:
    """Return options as ``kind``, which states their names, types, limits and defaults. Raises
    DeviceError.
    """
    known = ", ".join(kind.__struct_fields__)
    unknown = sorted(set(options) - set(kind.__struct_fields__))
    if unknown:
        raise DeviceError(f"unknown option {unknown[0]!r}; must be one of: {known}")
    try:
        return msgspec.convert(dict(options), kind)
    except msgspec.ValidationError as error:
        text = re.sub(r" - at `\$\.?(.*)`$", r" in option \1", str(error))
        raise DeviceError(f"{text[0].lower()}{text[1:]}; options: {known}") from None
