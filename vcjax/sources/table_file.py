"""Columns of numbers from and to CSV and Parquet files; a bad cell is refused by line, column and value.

The work is Apache Arrow's. A CSV file has a header; its lines are counted from 1, the header's, as editors show them.
The rows of a Parquet file are counted from 1. Columns that are not asked for are left alone.
"""

import csv
import mmap
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from vcjax import extras
from vcjax.storage import replacing

Kind = Literal["whole", "real"]

MAX_ROWS = 2**25
"""Most rows read from a file: what a Parquet file of a few kilobytes may state is not what memory holds."""

_MAX_HEADER_BYTES = 2**16
_WANTED = {"whole": "a whole number", "real": "a finite number"}


class Table(NamedTuple):
    """Columns of equal length, and where they come from."""

    path: Path
    columns: dict[str, np.ndarray]
    """int64 for whole numbers, float64 for real ones, which are finite, or NaN in columns where that is allowed."""

    def __getitem__(self, name: str) -> np.ndarray:  # type: ignore[override]
        """A column by its name."""
        return self.columns[name]

    @property
    def num_rows(self) -> int:
        """How many rows there are."""
        return len(next(iter(self.columns.values())))

    def place(self, row: int) -> str:
        """A row, counted from 0, as people find it: file and line, or row."""
        return f"{self.path}, row {row + 1}" if _is_parquet(self.path) else f"{self.path}, line {row + 2}"

    def refuse_where(self, is_bad: np.ndarray, name: str, remedy: str) -> None:
        """Refuse the first row where `is_bad`, with its value in a column."""
        rows = np.flatnonzero(is_bad)
        if len(rows):
            value = self[name][rows[0]]
            raise ValueError(f"{self.place(int(rows[0]))}, column {name}: {value} {remedy} ({len(rows)} such rows)")


def read_table(
    path: str | os.PathLike, kinds: Mapping[str, Kind], optional: Sequence[str] = (), undefined: Sequence[str] = ()
) -> Table:
    """Read some columns of a `.csv` or `.parquet` file.

    Args:
        path: the file; its ending tells its format.
        kinds: the columns, each of whole or of real numbers; spaces around names in a header do not count.
        optional: those that may be absent; they are then absent in the table too.
        undefined: columns of real numbers in which nan may stand, for what nobody knows.

    Raises:
        FileNotFoundError: if there is no such file.
        ModuleNotFoundError: if pyarrow is not installed, with the remedy.
        ValueError: naming file, line, column and value: another ending, a damaged file, a column that lacks or is there
            twice, a cell that is empty, no number, not finite, or too large for 64 bits.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    read = _read_parquet if _is_parquet(path) else _read_csv
    arrow = extras.load("pyarrow", "Tables", "images")
    try:
        columns = read(path, kinds, optional)
    except (arrow.ArrowException, UnicodeDecodeError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # of the system, which names the file
            raise
        raise ValueError(f"{path}: {_first_line(error)}") from error
    table = Table(path, columns)
    for name, column in columns.items():
        if column.dtype.kind == "f":
            is_bad = np.isinf(column) if name in undefined else ~np.isfinite(column)
            table.refuse_where(is_bad, name, "is not finite; leave out rows that measure nothing")
    return table


def write_table(path: str | os.PathLike, columns: Mapping[str, Any]) -> Path:
    """Write columns to a `.csv` or `.parquet` file, complete or not at all. Numbers come back as they are, bit for bit.

    Raises:
        ValueError: for another ending.
        OSError: if the place cannot be written; what was there before stays.
    """
    arrow = extras.load("pyarrow", "Tables", "images")
    import pyarrow.csv
    import pyarrow.parquet

    table = arrow.table({name: np.asarray(column) for name, column in columns.items()})
    write: Any = pyarrow.parquet.write_table if _is_parquet(Path(path)) else pyarrow.csv.write_csv
    with replacing(path) as temporary:
        write(table, temporary)
    return Path(path)


def _is_parquet(path: Path) -> bool:
    ending = path.suffix.lower()
    if ending not in (".csv", ".parquet"):
        raise ValueError(f"{path}: unknown ending {ending!r}; give a .csv or a .parquet file.")
    return ending == ".parquet"


def _read_csv(path: Path, kinds: Mapping[str, Kind], optional: Sequence[str]) -> dict[str, np.ndarray]:
    import pyarrow.csv as arrow_csv

    arrow = extras.load("pyarrow", "Tables", "images")
    with path.open("rb") as file:
        line = file.readline(_MAX_HEADER_BYTES)
    if len(line) == _MAX_HEADER_BYTES and not line.endswith(b"\n"):
        raise ValueError(f"{path}, line 1: longer than {_MAX_HEADER_BYTES} bytes; a table begins with its header.")
    if b"\r" in line.rstrip(b"\r\n"):
        raise ValueError(f"{path}: its lines end with carriage returns alone; save it with line feeds.")
    names = [name.strip() for name in next(csv.reader([line.decode("utf-8-sig")]), [])]
    found = _choose(path, names, kinds, optional)
    if not line.endswith(b"\n"):
        return {name: np.zeros(0, np.int64 if kinds[name] == "whole" else np.float64) for name in found}

    def read(types: Mapping[str, Any]) -> Any:
        return arrow_csv.read_csv(
            path,
            # One thread: only so Arrow counts lines. Columns that are not asked for may lack a name.
            arrow_csv.ReadOptions(
                use_threads=False, skip_rows=1, column_names=[name or f"\0{i}" for i, name in enumerate(names)]
            ),
            arrow_csv.ParseOptions(ignore_empty_lines=False),
            arrow_csv.ConvertOptions(include_columns=[*types], column_types=types, null_values=[]),
        )

    types = {"whole": arrow.int64(), "real": arrow.float64()}
    try:
        table = read({name: types[kinds[name]] for name in found})
    except arrow.ArrowInvalid as error:
        raise ValueError(_csv_refusal(path, str(error), names, kinds)) from error
    # Arrow takes 0x10 for a whole number, 16; so does nobody else.
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        may_be_hexadecimal = max(content.find(b"0x"), content.find(b"0X")) >= 0
    if may_be_hexadecimal and (whole := [name for name in found if kinds[name] == "whole"]):
        texts = read(dict.fromkeys(whole, arrow.string()))
        for name in whole:
            for row, text in enumerate(texts[name].to_pylist()):
                if "x" in text.lower():
                    raise ValueError(f"{path}, line {row + 2}, column {name}: {text[:40]!r} is not {_WANTED['whole']}.")
    return {name: table[name].to_numpy() for name in found}


def _csv_refusal(path: Path, message: str, names: list[str], kinds: Mapping[str, Kind]) -> str:
    """Arrow's message in the words of a table's reader."""
    if found := re.match(r"In CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", message, re.DOTALL):
        column, line, value = names[int(found[1])], found[2], found[3]
        shown = repr(value if len(value) <= 40 else f"{value[:37]}…")
        return f"{path}, line {line}, column {column}: {shown} is not {_WANTED[kinds[column]]}."
    if found := re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", message):
        return f"{path}, line {found[1]}: {found[3]} cells, but the header names {found[2]} columns."
    if "newlines_in_values" in message:
        with path.open("rb") as file:
            open_quote = next((n for n, line in enumerate(file, 1) if line.count(b'"') % 2), None)
        return f"{path}, line {open_quote}: a quote that is not closed in the same line."
    return f"{path}: {_first_line(message)}"


def _read_parquet(path: Path, kinds: Mapping[str, Kind], optional: Sequence[str]) -> dict[str, np.ndarray]:
    import pyarrow.parquet as parquet

    arrow = extras.load("pyarrow", "Tables", "images")
    with parquet.ParquetFile(path) as file:
        if file.metadata.num_rows > MAX_ROWS:
            raise ValueError(f"{path}: {file.metadata.num_rows} rows, more than {MAX_ROWS}; split the file.")
        found = _choose(path, file.schema_arrow.names, kinds, optional)
        for name in found:
            kind = file.schema_arrow.field(name).type
            is_whole = arrow.types.is_integer(kind)
            if not (is_whole or (kinds[name] == "real" and arrow.types.is_floating(kind))):
                raise ValueError(f"{path}, column {name}: of type {kind}; store {_WANTED[kinds[name]]} in each row.")
        table = file.read(found)
    columns = {}
    for name in found:
        column = table[name].combine_chunks()
        if column.null_count:
            row = int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
            raise ValueError(f"{path}, row {row + 1}, column {name}: empty; each row needs {_WANTED[kinds[name]]}.")
        wide = arrow.int64() if kinds[name] == "whole" else arrow.float64()
        try:
            columns[name] = column.cast(wide).to_numpy(zero_copy_only=False)
        except arrow.ArrowInvalid as error:
            values, limit = column.to_numpy(zero_copy_only=False), 2**63 - 1 if kinds[name] == "whole" else 2**53
            row = int(np.flatnonzero((values > limit) | (values < -limit))[0])
            place = f"{path}, row {row + 1}, column {name}"
            raise ValueError(f"{place}: {values[row]} is too large for {_WANTED[kinds[name]]} of 64 bits.") from error
    return columns


def _choose(path: Path, names: Sequence[str], kinds: Mapping[str, Kind], optional: Sequence[str]) -> list[str]:
    """The wanted columns that are there; refused if one lacks or is there twice."""
    for name in kinds:
        if names.count(name) > 1:
            raise ValueError(f"{path}: column {name} is there {names.count(name)} times; give it once.")
        if name not in names and name not in optional:
            shown = ", ".join(repr(n[:20]) for n in names[:8]) or "none"
            raise ValueError(f"{path}: no column {name}; the first line names {shown}.")
    return [name for name in kinds if name in names]


def _first_line(error: object) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
