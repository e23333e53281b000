"""Parquet and Feather files that other programs wrote: what cannot be understood is one line with the file's name."""

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.detection_files import TableImport, read_detections
from data_tools.files.readers import arrow_columns
from saga_fg.errors import InputError

pa = pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
pytest.importorskip("pyarrow.parquet")
pytest.importorskip("pyarrow.feather")

X = [1.0, 2.0]


def write(path: Path, columns: list[tuple[str, Any]]) -> Path:
    table = pa.table([values for _, values in columns], names=[name for name, _ in columns])
    (pa.parquet.write_table if path.suffix == ".parquet" else pa.feather.write_feather)(table, path)
    return path


def test_two_columns_of_one_name_are_refused(tmp_path, subtests):
    for suffix in [".parquet", ".feather"]:
        with subtests.test(suffix=suffix):
            path = write(tmp_path / f"a{suffix}", [("time", [0.0, 0.1]), ("x", X), ("x", X), ("y", X)])
            with pytest.raises(InputError, match=rf"^{path}: expected every column once, got time, x, x, y$"):
                read_detections(path)


def test_columns_of_other_types_are_named(tmp_path, subtests):
    for suffix in [".parquet", ".feather"]:
        for values, message in [
            (pa.array([{"a": 1.0}, {"a": 2.0}]), "x: expected an array of numbers, got list"),
            (pa.array(["1", "2"]).dictionary_encode(), "row 0: x: expected a number, got '1'"),
            (pa.array([None, None]), "row 0: x: expected a finite number of metres, it is left out"),
            (pa.array([True, False]), "x: expected an array of numbers, got bool"),
        ]:
            with subtests.test(message):
                path = write(tmp_path / f"a{suffix}", [("time", [0.0, 0.1]), ("x", values), ("y", X)])
                with pytest.raises(InputError, match=rf"^{path}: {message}"):
                    read_detections(path)


def test_columns_have_their_values_and_dates_are_text(tmp_path):
    day = date(2024, 5, 1)
    columns = [
        ("x", pa.array(X)),
        ("n", pa.array([1, None])),
        ("day", pa.array([day, None])),
        ("s", pa.array(["a", "b"])),
    ]
    path = write(tmp_path / "a.parquet", columns)
    found = arrow_columns(path, ("s", "day", "x", "n"))
    np.testing.assert_array_equal(found.pop("x"), X)
    assert found == {"s": ["a", "b"], "day": ["2024-05-01", None], "n": [1, None]}


def test_a_column_that_grows_beyond_the_memory_is_one_line(tmp_path, monkeypatch):
    from data_tools.files import isolated_reading

    monkeypatch.setattr(isolated_reading, "MEMORY", 10**6)
    n = 10**6
    path = write(tmp_path / "a.parquet", [("time", np.arange(n)), ("x", np.zeros(n)), ("y", np.zeros(n))])
    with pytest.raises(InputError, match=rf"^{path}: expected a readable Parquet file: it holds more than"):
        read_detections(path)


def test_dates_without_a_time_are_no_times(tmp_path, subtests):
    for rows in [[date(2024, 5, 1)] * 2, [date(2024, 5, 1), date(2024, 5, 2)], ["2024-05-01"] * 2]:
        with subtests.test(rows=rows):
            path = write(tmp_path / "a.parquet", [("date", rows), ("x", X), ("y", X)])
            how = TableImport(columns={"timestamp": "date"})
            with pytest.raises(
                InputError, match=r"a\.parquet: timestamp \(column 'date'\): expected times with the time of"
            ):
                read_detections(path, how=how)


def test_dates_without_a_time_are_no_times_in_text(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,x,y\n2024-05-01,1,2\n2024-05-01,3,4\n")
    with pytest.raises(InputError, match=r"a\.csv: timestamp \(column 'time'\): expected times with the time of day"):
        read_detections(path)


@pytest.mark.parametrize("rows", [["2024-05-01 00:00:00"] * 2, ["2024-05-01T00:00:00Z", "2024-05-02T00:00:00Z"]])
def test_dates_at_midnight_alone_are_doubtful(tmp_path, rows):
    scene = read_detections(write(tmp_path / "a.parquet", [("time", rows), ("x", X), ("y", X)])).scene("a")
    assert "dates have no time of day: all rows of a day are one frame" in str(scene.findings)
