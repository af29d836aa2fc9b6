# SPDX-License-Identifier: Apache-2.0
"""Write tables of a log as Parquet or CSV files while reading it: memory does not grow with its length."""

from __future__ import annotations

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from chaserdock_protocol.recording.log import LogError, LogSource, read_log

from .tables import TopicTable

_ROWS, _IMAGE_ROWS = 4096, 64


class _ParquetFile:
    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._writer = pq.ParquetWriter(path, schema, compression="zstd")

    def write(self, table: pa.Table) -> None:
        self._writer.write_table(table)

    def close(self) -> None:
        self._writer.close()


class _CsvFile:
    """Lists become JSON text, missing values empty cells."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(schema.names)

    def write(self, table: pa.Table) -> None:
        columns = [[_cell(v) for v in column.to_pylist()] for column in table.columns]
        self._writer.writerows(zip(*columns, strict=True))

    def close(self) -> None:
        self._file.close()


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        return json.dumps(value)
    return value.hex() if isinstance(value, bytes) else value


def export(
    log: LogSource, folder: Path, format: Literal["parquet", "csv"], images: bool = False
) -> dict[str, int]:
    """Write every topic of a log into ``folder``, which is created; return the number of rows by file name.

    ``images``: include the bytes of the images. Raises LogError when the log or the files cannot be used.
    """
    tables: dict[str, TopicTable] = {}
    files: dict[str, Any] = {}
    rows: Counter[str] = Counter()

    def write(table: TopicTable) -> None:
        for name, chunk in table.take_all():
            path = folder / f"{name}.{format}"
            if name not in files:
                if path.exists():
                    raise LogError(f"{path}: already exists; export into an empty folder")
                files[name] = (_ParquetFile if format == "parquet" else _CsvFile)(path, chunk.schema)
            files[name].write(chunk)
            rows[path.name] += chunk.num_rows

    try:
        folder.mkdir(parents=True, exist_ok=True)
        for record in read_log(log):
            table = tables.get(record.topic.key)
            if table is None:
                table = tables[record.topic.key] = TopicTable(record.topic, images)
            table.add(record)
            if table.number >= (_IMAGE_ROWS if images else _ROWS):
                write(table)
        for table in tables.values():
            write(table)
    except OSError as error:
        raise LogError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        for file in files.values():
            file.close()
    return dict(sorted(rows.items()))
