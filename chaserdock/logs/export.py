# SPDX-License-Identifier: Apache-2.0
"""Writes tables of a log as Parquet or CSV files while reading it, so that memory is bounded."""

from __future__ import annotations

import csv
import json
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import replaced
from chaserdock_protocol.recording.log import LogError, LogSource, read_log

from .tables import TopicTable

TableFormat = Literal["parquet", "csv"]
_ROWS, _IMAGE_ROWS = 4096, 64
"""Rows of a table that are held in memory before they are written, without and with the bytes of
images. Larger: more memory; smaller: larger files. 64 grey images of 640 x 480 px are 20 MB.
"""


class _CsvFile:
    """A CSV file with the interface of ``ParquetWriter``. Lists are written as JSON text, missing
    values as empty cells.
    """

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(schema.names)

    def write_table(self, table: pa.Table) -> None:
        columns = [[_cell(v) for v in column.to_pylist()] for column in table.columns]
        self._writer.writerows(zip(*columns, strict=True))

    def close(self) -> None:
        self._file.close()


def create_table_file(path: Path, schema: pa.Schema, format: TableFormat) -> Any:
    """Return a new file with `write_table` and `close`, as `pyarrow.parquet.ParquetWriter`."""
    return (
        pq.ParquetWriter(path, schema, compression="zstd")
        if format == "parquet"
        else _CsvFile(path, schema)
    )


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        return json.dumps(value)
    return value.hex() if isinstance(value, bytes) else value


def export(
    log: LogSource, folder: Path, format: TableFormat, images: bool = False
) -> dict[str, int]:
    """Write every topic of a log into ``folder``, which is created. Returns the number of rows by
    file name.

    ``images``: include the bytes of the images. Raises LogError if the log or the files cannot be
    used.
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
                new = open_files.enter_context(replaced(path))
                files[name] = open_files.enter_context(
                    closing(create_table_file(new, chunk.schema, format))
                )
            files[name].write_table(chunk)
            rows[path.name] += chunk.num_rows

    with errors_of_writing(folder, LogError), ExitStack() as open_files:
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
    return dict(sorted(rows.items()))
