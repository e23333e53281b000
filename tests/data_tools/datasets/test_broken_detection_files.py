"""Tables of detections with faults: each is named with its record and field."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.detection_files import read_detections
from saga_fg import InputError
from tests.data_tools.datasets.drive_tables import NPZ, write

HEAD = "timestamp,x,y,z,length,score,label\n0,1,1,1,1,1,car\n"
OPEN_QUOTE = "expected comma-separated values: a quote is opened and not closed on this line"
BROKEN_CSV = [
    ("", "expected a column 'timestamp' and a column 'x' and a column 'y', the columns there are none"),
    ("timestamp,x,y\n", "expected at least one row"),
    ("timestamp,x\n0,1\n", "expected a column 'y', the columns there are timestamp, x"),
    ("timestamp,x,y,lenght\n0,1,1,4\n", "unknown column 'lenght'; did you mean 'length'"),
    ("timestamp,x,x,y\n0,1,1,4\n", "line 1: expected every column once"),
    (HEAD + "1,2\n", "line 3: expected 7 columns, got 2"),
    (HEAD + "\n1,far,1,1,1,1,car\n", "line 4: x: expected a number, got 'far'"),
    (HEAD + "1,nan,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, got nan"),
    (HEAD + "1,1,inf,1,1,1,car\n", "line 3: y: expected a finite number, got inf"),
    (HEAD + "1,1,1e999,1,1,1,car\n", "line 3: y: expected a finite number, got inf"),
    (HEAD + "1,,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, it is left out"),
    (HEAD + "1,1,1,1,-4,1,car\n", "line 3: length: expected a positive number of metres, got -4"),
    (HEAD + "1,1,1,1,0,1,car\n", "line 3: length: expected a positive number of metres, got 0"),
    (HEAD + "1,1,1,1,1,nan,car\n", "line 3: score: expected a finite number, got nan"),
    (HEAD + ",1,1,1,1,1,car\n", "line 3: timestamp: expected a finite number of seconds, it is left out"),
    (HEAD + "-1,1,1,1,1,1,car\n", "line 3: timestamp: expected rows in order of time, time runs backwards at -1.0 s"),
    ("timestamp,x,y,coordinates\n0,1,1,map\n", "line 2: coordinates: expected world, ego or sensor, got 'map'"),
    ("timestamp,x,y,coordinates\n0,1,1,ego\n", "line 2: coordinates: ego needs the columns ego_x, ego_y and ego_yaw"),
    ("timestamp,x,y,ego_x\n0,1,1,3\n", "line 2: ego_y: expected a finite number, since ego_x is given, it is left out"),
    (HEAD + "1,1,1,1,1,1," + "c" * 200_000, "line 3: expected comma-separated values: field larger"),
    (HEAD + "1,1,1,1,1,1," + "c" * 1000, "line 3: label: expected a name of at most 256 characters, got 1000"),
    (HEAD + '1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 1000, f"line 3: {OPEN_QUOTE}"),
    (HEAD + '1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 9 + '1,1,1,1,1,1,car"\n', f"line 3: {OPEN_QUOTE}"),
    (HEAD + '\n1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 10_000, f"line 4: {OPEN_QUOTE}"),
    ('"timestamp,x,y\n0,1,1\n', f"line 1: {OPEN_QUOTE}"),
    (HEAD + '1,1,1,1,1,1,"ca"r\n', "line 3: expected comma-separated values: ',' expected after '\"'"),
    ("timestamp,x,y,empty\n0,1,1,yes\n", "empty: expected an array of booleans, in NumPy archives only"),
]


def test_broken_csv(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_CSV:
        with subtests.test(message):
            with pytest.raises(InputError, match=r"drive\.csv: " + re.escape(message)) as caught:
                read_detections(write(tmp_path, ".csv", text))
            assert "\n" not in str(caught.value)


def test_frame_with_two_poses_or_two_kinds_of_coordinates(tmp_path: Path) -> None:
    poses = "timestamp,x,y,ego_x,ego_y,ego_yaw\n0,1,1,0,0,0\n0,1,1,0,1,0\n"
    with pytest.raises(InputError, match="line 3: ego_x, ego_y, ego_z, ego_yaw: expected one pose at one time"):
        read_detections(write(tmp_path, ".csv", poses)).scene("drive")
    kinds = "timestamp,x,y,ego_x,ego_y,ego_yaw,coordinates\n0,1,1,0,0,0,ego\n0,1,1,0,0,0,world\n"
    with pytest.raises(InputError, match="line 3: coordinates: expected the same in all rows of a frame"):
        read_detections(write(tmp_path, ".csv", kinds)).scene("drive")


FIRST = '{"timestamp": 0, "x": 1, "y": 1}\n'
BROKEN_NDJSON = [
    (FIRST + '{"timestamp": 1, "x"', "line 2: broken or truncated JSON"),
    (FIRST + "[1]", "line 2: expected an object, got '[1]'"),
    (FIRST + '{"timestamp": 1, "x": "2", "y": 1}', "line 2: x: expected a number, got '2'"),
    (FIRST + '{"timestamp": 1, "x": true, "y": 1}', "line 2: x: expected a number, got 'True'"),
    (FIRST + '{"timestamp": 1, "x": [], "y": 1}', "line 2: x: expected a number, got '[]'"),
    (FIRST + '{"timestamp": 1, "x": NaN, "y": 1}', "line 2: x: expected a finite number of metres, got nan"),
    (FIRST + '{"timestamp": 1, "x": 1, "y": 1, "label": 3}', "line 2: label: expected a name, got 3"),
    (FIRST + '{"x": 1, "y": 1}', "line 2: timestamp: expected a finite number of seconds, it is left out"),
    (FIRST + '{"timestamp": 1, "x": 1' + "0" * 400 + ', "y": 1}', "line 2: x: expected a finite number, got inf"),
    (FIRST + "[" * 100_000, "line 2: broken or truncated JSON"),
    ("", "expected at least one row"),
]


def test_broken_ndjson(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in BROKEN_NDJSON:
        with subtests.test(message), pytest.raises(InputError, match=r"drive\.ndjson: " + re.escape(message)):
            read_detections(write(tmp_path, ".ndjson", text))


BROKEN_NPZ: list[tuple[dict[str, Any], str]] = [
    ({"x": [1]}, "x: expected shape (4,) as timestamp has, got (1,)"),
    ({"x": [[1]] * 4}, "x: expected shape (4,) as timestamp has, got (4, 1)"),
    ({"x": ["1"] * 4}, "x: expected an array of numbers, got <U1"),
    ({"label": [1] * 4}, "label: expected an array of strings, got int64"),
    ({"empty": [1, 0, 0, 0]}, "empty: expected an array of booleans"),
    ({"empty": [False] * 4}, "row 2: x: expected a finite number of metres, got nan"),
    (
        {"label": np.array(["a", 1, None, "b"], dtype=object)},
        "expected NumPy's format, with plain arrays and no pickled objects",
    ),
]


def test_broken_npz(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for changes, message in BROKEN_NPZ:
        with subtests.test(message), pytest.raises(InputError, match=r"drive\.npz: " + re.escape(message)):
            read_detections(write(tmp_path, ".npz", NPZ | changes))


def test_npz_that_is_none(tmp_path: Path) -> None:
    path = write(tmp_path, ".npz")
    whole = path.read_bytes()
    for content in (b"", b"text", whole[:200], whole[:-30]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"drive\.npz: expected NumPy's format, with plain arrays"):
            read_detections(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match="got a single array"):
        read_detections(path)


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"drive\.txt: expected a file name that ends in \.csv, \.ndjson"):
        read_detections(tmp_path / "drive.txt")
    for suffix in (".csv", ".ndjson", ".npz"):
        with pytest.raises(InputError, match=rf"drive\{suffix}: cannot be read: No such file"):
            read_detections(tmp_path / f"drive{suffix}")
    (tmp_path / "drive.csv").write_bytes(b"timestamp,x,y\n\xff\xfe")
    with pytest.raises(InputError, match=r"drive\.csv: expected text in UTF-8"):
        read_detections(tmp_path / "drive.csv")
