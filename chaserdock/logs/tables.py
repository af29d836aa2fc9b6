# SPDX-License-Identifier: Apache-2.0
"""Messages as tables: one row per message, nested fields as columns, units in the columns'
metadata.

Columns: ``key``, ``sent_ns`` (the sender's wall clock), ``time_s`` (simulated), then the message's
fields. Vectors become ``position_m_x`` …, quaternions ``q_w`` …; dictionaries become JSON text;
lists of numbers stay lists. Lists of structures (the solutions of a sighting) become a table of
their own, with ``key``, ``seq``, ``tick``, ``time_s`` and ``index``. The bytes of images are left
out by default (``data_bytes`` is their number).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
import pyarrow as pa
from chaserdock_protocol.recording.log import Record
from chaserdock_protocol.topics import TOPICS, Topic
from msgspec import inspect

UNITS = {
    "rad2_s2": "rad²/s²",
    "m2_s2": "m²/s²",
    "kg_m2": "kg m²",
    "rad_s": "rad/s",
    "N_m_s": "N m s",
    "m_s": "m/s",
    "N_m": "N m",
    "N_s": "N s",
    "rad2": "rad²",
    "m2": "m²",
    "rad": "rad",
    "deg": "deg",
    "px": "px",
    "ns": "ns",
    "kg": "kg",
    "Hz": "Hz",
    "m": "m",
    "N": "N",
    "s": "s",
}
"""Units by the end of a field's name; longer ends first."""

Reader = Callable[[Any], Any]
Column = tuple[str, pa.DataType, Reader]


def unit_of(name: str) -> str | None:
    """Return the unit in a field's name, None if it has none."""
    return next((unit for end, unit in UNITS.items() if name.endswith(f"_{end}")), None)


def _get(name: str) -> Reader:
    return lambda message: getattr(message, name)


def _item(name: str, k: int) -> Reader:
    def read(message: Any) -> Any:
        value = getattr(message, name)
        return None if value is None else value[k]

    return read


def _part(name: str, read: Reader) -> Reader:
    """Return a reader of one column of a nested structure, which may be None."""
    return lambda message: None if getattr(message, name) is None else read(getattr(message, name))


def _json(name: str) -> Reader:
    return lambda message: json.dumps(getattr(message, name), sort_keys=True)


def _plain(kind: inspect.Type) -> pa.DataType | None:
    """Return Arrow's type of a plain value or a list of plain values; None for any other type."""
    match kind:
        case inspect.BoolType():
            return pa.bool_()
        case inspect.IntType():
            return pa.int64()
        case inspect.FloatType():
            return pa.float64()
        case inspect.StrType() | inspect.LiteralType():
            return pa.string()
        case inspect.BytesType():
            return pa.binary()
        case inspect.VarTupleType(item_type=item):
            inner = _plain(item)
            return None if inner is None else pa.list_(inner)
        case inspect.TupleType(item_types=items):
            inner = _plain(items[0])
            return None if inner is None else pa.list_(inner)
    return None


def _columns(kind: type[msgspec.Struct], images: bool) -> tuple[list[Column], list[str]]:
    """Return the columns of a structure, and its fields that become tables of their own."""
    columns: list[Column] = []
    children: list[str] = []
    info: Any = inspect.type_info(kind)
    for field in info.fields:
        name, type_ = field.name, field.type
        if isinstance(type_, inspect.UnionType):
            type_ = next(t for t in type_.types if not isinstance(t, inspect.NoneType))
        match type_:
            case inspect.DictType():
                columns.append((name, pa.string(), _json(name)))
            case inspect.TupleType(item_types=items) if len(items) in (3, 4):
                axes, stem = (
                    ("xyz", name) if len(items) == 3 else ("wxyz", name.removesuffix("_wxyz"))
                )
                for k, axis in enumerate(axes):
                    columns.append((f"{stem}_{axis}", pa.float64(), _item(name, k)))
            case inspect.VarTupleType(item_type=inspect.StructType()):
                children.append(name)
            case inspect.StructType(cls=part):
                columns += [
                    (f"{name}_{n}", t, _part(name, read))
                    for n, t, read in _columns(part, images)[0]
                ]
            case inspect.BytesType() if not images:
                columns.append(
                    (f"{name}_bytes", pa.int64(), lambda message, n=name: len(getattr(message, n)))
                )
            case _:
                plain = _plain(type_)
                if plain is None:
                    raise TypeError(f"{kind.__name__}.{name}: no column for {type_}")
                columns.append((name, plain, _get(name)))
    return columns, children


def _element(kind: type[msgspec.Struct], field: str) -> type[msgspec.Struct]:
    """Return the type of the structures in a field that holds a tuple of them."""
    hint = get_type_hints(kind)[field]
    while get_origin(hint) is not tuple:
        hint = get_args(hint)[0]
    return get_args(hint)[0]


def _field(name: str, type_: pa.DataType) -> pa.Field:
    stem = name[:-2] if name[-2:] in ("_x", "_y", "_z") else name
    unit = unit_of(stem)
    return pa.field(name, type_, metadata=None if unit is None else {"unit": unit})


class TableRows:
    """Collects rows of one table until they are taken."""

    def __init__(self, columns: list[Column]) -> None:
        self.schema = pa.schema([_field(name, type_) for name, type_, _ in columns])
        self._readers = [reader for _, _, reader in columns]
        self._values: list[list[Any]] = [[] for _ in columns]
        self.number = 0

    def add(self, row: Any) -> None:
        """Add a row: the values that the columns' readers return."""
        for values, reader in zip(self._values, self._readers, strict=True):
            values.append(reader(row))
        self.number += 1

    def take(self) -> pa.Table:
        """Return the rows since the last call and drop them."""
        arrays = [pa.array(v, f.type) for v, f in zip(self._values, self.schema, strict=True)]
        self._values = [[] for _ in self._values]
        self.number = 0
        return pa.Table.from_arrays(arrays, schema=self.schema)


def table_name(topic: Topic) -> str:
    """Return the name of a topic's table, such as ``chaser_sighting`` or ``world_chaser_image``."""
    return (
        topic.key.replace("/{chaser}", "")
        .replace("{process}/", "")
        .replace("/{process}", "")
        .replace("/", "_")
    )


def table_names(topic: Topic) -> list[str]:
    """Return the names of a topic's tables: its own, and those of its lists of structures."""
    own = table_name(topic)
    return [own, *(f"{own}_{field}" for field in _columns(topic.kind, images=False)[1])]


def topic_of_table(name: str) -> Topic | None:
    """Return the topic that has a table of this name, or None."""
    return next((topic for topic in TOPICS if name in table_names(topic)), None)


class TopicTable:
    """The table of a topic, and tables of its lists of structures (``children``, by field)."""

    def __init__(self, topic: Topic, images: bool = False) -> None:
        columns, children = _columns(topic.kind, images)
        head: list[Column] = [
            ("key", pa.string(), lambda r: r.key),
            ("sent_ns", pa.int64(), lambda r: r.sent_ns),
            ("time_s", pa.float64(), lambda r: r.message.sim_time_ns / 1e9),
        ]
        self.name = table_name(topic)
        self._rows = TableRows([*head, *((n, t, _of_message(reader)) for n, t, reader in columns)])
        self.children: dict[str, TableRows] = {}
        for name in children:
            inner = _columns(_element(topic.kind, name), images)[0]
            self.children[name] = TableRows(
                [
                    ("key", pa.string(), lambda r: r[0].key),
                    ("seq", pa.int64(), lambda r: r[0].message.seq),
                    ("tick", pa.int64(), lambda r: r[0].message.tick),
                    ("time_s", pa.float64(), lambda r: r[0].message.sim_time_ns / 1e9),
                    ("index", pa.int64(), lambda r: r[1]),
                    *((n, t, _of_item(reader)) for n, t, reader in inner),
                ]
            )

    @property
    def number(self) -> int:
        """Return the number of rows of the longest table that are not yet taken."""
        return max(self._rows.number, *(c.number for c in self.children.values()), 0)

    def add(self, record: Record) -> None:
        """Add a message."""
        self._rows.add(record)
        for name, rows in self.children.items():
            for index, item in enumerate(getattr(record.message, name) or ()):
                rows.add((record, index, item))

    def take(self) -> pa.Table:
        """Return the topic's own rows since the last call."""
        return self._rows.take()

    def take_all(self) -> Iterator[tuple[str, pa.Table]]:
        """Return the rows of all tables since the last call, by table name."""
        yield self.name, self._rows.take()
        for name, rows in self.children.items():
            yield f"{self.name}_{name}", rows.take()


def _of_message(reader: Reader) -> Reader:
    return lambda record: reader(record.message)


def _of_item(reader: Reader) -> Reader:
    return lambda row: reader(row[2])
