"""Tables of numbers: there and back bit for bit, and a bad cell found by line, column and value."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcjax.sources.table_file import MAX_ROWS, read_table, write_table

KINDS = {"frame": "whole", "u": "real"}


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False))))
def test_numbers_come_back_bit_for_bit(tmp_path_factory, ending, rows):
    whole = np.array([row[0] for row in rows], np.int64)
    real = np.array([row[1] for row in rows], np.float64)
    path = tmp_path_factory.mktemp("table") / f"a.{ending}"
    found = read_table(write_table(path, {"u": real, "more": whole, "frame": whole}), KINDS)
    assert found["frame"].tobytes() == whole.tobytes() and found["u"].tobytes() == real.tobytes()
    assert found["u"].dtype == np.float64 and found["frame"].dtype == np.int64 and found.num_rows == len(rows)
    assert set(found.columns) == {"frame", "u"}


@pytest.mark.parametrize(
    "text",
    [
        "frame,u\n1,0.5\n2,7\n",
        "u,frame\n0.5,1\n7e0,2",
        "\ufeff frame , u ,,\r\n 1, 0.5,a,\r\n 2 ,7.0 ,b,\r\n",
        "frame,u,name\n1,0.5,0x10\n2,7,0x11\n",
        '"frame","u","what ""it"" is"\n"1","0.5","x, y"\n"2","7","z"\n',
    ],
    ids=["plain", "other order", "spaces, mark and returns", "hexadecimal elsewhere", "quoted"],
)
def test_ways_of_writing_the_same(tmp_path, text):
    (tmp_path / "a.CSV").write_text(text, newline="")
    found = read_table(tmp_path / "a.CSV", KINDS)
    assert found["frame"].tolist() == [1, 2] and found["u"].tolist() == [0.5, 7.0]


def test_tables_without_rows(tmp_path):
    for text in ("frame,u", "frame,u\n"):
        (tmp_path / "a.csv").write_text(text)
        assert read_table(tmp_path / "a.csv", KINDS).num_rows == 0


BAD_CSV = {
    "nothing": ("", r"a\.csv: no column frame; the first line names none"),
    "other columns": ("frame;u\n1;2\n", r"no column frame; the first line names 'frame;u'"),
    "no header": ("1,0.5\n2,0.5\n", "no column frame; the first line names '1', '0.5'"),
    "column twice": ("frame,u,u\n1,2,3\n", "column u is there 2 times"),
    "word": ("frame,u\n1,0.5\n2,left\n", r"a\.csv, line 3, column u: 'left' is not a finite number"),
    "empty cell": ("frame,u\n1,0.5\n2,\n", r"line 3, column u: '' is not a finite number"),
    "fraction": ("frame,u\n1,0.5\n2.5,1\n", r"line 3, column frame: '2\.5' is not a whole number"),
    "too large": (f"frame,u\n1,0.5\n{2**63},1\n", "line 3, column frame: '9223372036854775808' is not a whole"),
    "too large a number": ("frame,u\n1,1e400\n", r"line 2, column u: inf is not finite; leave out rows"),
    "NaN": ("frame,u\n1,0.5\n2,nan\n3,nan\n", r"line 3, column u: nan is not finite; .*\(2 such rows\)"),
    "hexadecimal": ("frame,u,name\n1,0.5,0x3\n0X10,7,\n", r"line 3, column frame: '0X10' is not a whole number"),
    "open quote": (
        "frame,u\n" + "1,0.5\n" * 300_000 + '2,"7\n' + "3,0.5\n" * 300_000,
        "line 300002: .*quote.*not closed",
    ),
    "short row": ("frame,u\n1,0.5\n2\n", "line 3: 1 cells, but the header names 2 columns"),
    "long row": ("frame,u\n1,0.5\n2,3,4\n", "line 3: 3 cells, but"),
    "empty line": ("frame,u\n1,0.5\n\n2,0.5\n", "line 3(: 1 cells|, column frame: '' is)"),
    "long word": ("frame,u\n1," + "x" * 1000 + "\n", "column u: 'x{37}…' is not"),
    "carriage returns": ("frame,u\r1,0.5\r", r"a\.csv: its lines end with carriage returns alone"),
    "long header": ("frame,u," + "x" * 2**16 + "\n1,0.5,0\n", r"a\.csv, line 1: longer than 65536 bytes"),
    "no text": (b"\xff\xfe\x00\n", r"a\.csv: 'utf-8' codec"),
    "zeros": (b"\x00" * 100, r"a\.csv: "),
}


@pytest.mark.parametrize(("content", "message"), BAD_CSV.values(), ids=BAD_CSV)
def test_bad_csv_is_refused_by_line_column_and_value(tmp_path, content, message):
    path = tmp_path / "a.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as refusal:
        read_table(path, KINDS)
    assert str(path) in str(refusal.value) and len(str(refusal.value)) < 400 + len(str(path))


BAD_PARQUET = {
    "lacks": ({"frame": [1]}, "no column u"),
    "words": ({"frame": [1], "u": ["a"]}, "column u: of type .*string; store a finite number in each row"),
    "fractions": ({"frame": [1.0], "u": [1.0]}, "column frame: of type double; store a whole number"),
    "hole": ({"frame": [1, 2, None], "u": [1.0, 2.0, 3.0]}, "row 3, column frame: empty; each row needs a whole"),
    "NaN": ({"frame": [1, 2], "u": [1.0, np.nan]}, "row 2, column u: nan is not finite"),
    "too large": ({"frame": pa.array([2**63], pa.uint64()), "u": [1.0]}, "row 1, column frame: 9223372036854775808 is"),
    "no double": (
        {"frame": [1, 2], "u": pa.array([1, 2**60 + 1])},
        "row 2, column u: 1152921504606846977 is too large",
    ),
}


@pytest.mark.parametrize(("columns", "message"), BAD_PARQUET.values(), ids=BAD_PARQUET)
def test_bad_parquet_is_refused_by_row_column_and_value(tmp_path, columns, message):
    parquet.write_table(pa.table(columns), tmp_path / "a.parquet")
    with pytest.raises(ValueError, match=message) as refusal:
        read_table(tmp_path / "a.parquet", KINDS)
    assert "a.parquet" in str(refusal.value)


def test_whole_numbers_and_single_precision_will_do_for_real_ones(tmp_path):
    parquet.write_table(
        pa.table({"frame": pa.array([1], pa.uint8()), "u": pa.array([7], pa.int16())}), tmp_path / "a.parquet"
    )
    found = read_table(tmp_path / "a.parquet", KINDS)
    assert found["u"].tolist() == [7.0] and found["frame"].dtype == np.int64
    parquet.write_table(pa.table({"frame": [1], "u": pa.array([0.5], pa.float32())}), tmp_path / "a.parquet")
    assert read_table(tmp_path / "a.parquet", KINDS)["u"].tolist() == [0.5]


def test_damaged_parquet_is_refused(tmp_path):
    path = write_table(tmp_path / "a.parquet", {"frame": np.arange(1000), "u": np.random.default_rng(0).random(1000)})
    whole = path.read_bytes()
    for length in (0, 4, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.parquet: "):
            read_table(path, KINDS)


def test_every_flipped_byte_of_a_parquet_file_is_refused_by_name_or_read(tmp_path):
    path = write_table(tmp_path / "a.parquet", {"frame": np.arange(50), "u": np.random.default_rng(0).random(50)})
    whole, refused = path.read_bytes(), 0
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            read_table(path, KINDS)
        except ValueError as error:
            refused += 1
            assert "a.parquet" in str(error), error
    assert refused > 20


def test_parquet_that_states_too_many_rows_takes_no_memory(tmp_path):
    """Equal values pack a thousand to one: two columns of more than 2²⁵ rows are a small file."""
    path = tmp_path / "a.parquet"
    rows = 2**22
    group = pa.table({"frame": np.zeros(rows, np.int64), "u": np.zeros(rows)})
    with parquet.ParquetWriter(path, group.schema) as writer:
        for _ in range(MAX_ROWS // rows + 1):
            writer.write_table(group)
    assert path.stat().st_size < 2**20
    before = pa.total_allocated_bytes()
    with pytest.raises(ValueError, match=f"rows, more than {MAX_ROWS}; split the file"):
        read_table(path, KINDS)
    assert pa.total_allocated_bytes() - before < 2**20


def test_one_bad_cell_in_a_million_rows_is_found(tmp_path):
    rng = np.random.default_rng(0)
    path = write_table(tmp_path / "a.csv", {"frame": np.arange(1_000_000) // 100, "u": rng.random(1_000_000)})
    assert read_table(path, KINDS).num_rows == 1_000_000
    lines = path.read_bytes().split(b"\n")
    lines[654_320] = b"6543,0.5.5"
    path.write_bytes(b"\n".join(lines))
    with pytest.raises(ValueError, match=r"a\.csv, line 654321, column u: '0\.5\.5' is not a finite number"):
        read_table(path, KINDS)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.txt").touch()
    with pytest.raises(ValueError, match=r"a\.txt: unknown ending '.txt'; give a \.csv or a \.parquet file"):
        read_table(tmp_path / "a.txt", KINDS)
    with pytest.raises(ValueError, match="unknown ending ''"):
        write_table(tmp_path / "a", {"u": np.zeros(1)})
    with pytest.raises(FileNotFoundError, match=r"none\.csv: no such file"):
        read_table(tmp_path / "none.csv", KINDS)


def test_failure_to_write_leaves_the_old_file(tmp_path):
    path = write_table(tmp_path / "a.csv", {"u": np.ones(3)})
    before = path.read_bytes()
    with pytest.raises(pa.ArrowException):
        write_table(path, {"u": np.zeros(3), "v": np.zeros(4)})
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.csv"]
