"""Tables of other people: their columns, units, classes and order, in files that other libraries wrote."""

import csv
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.datasets.detection_files import (
    TableImport,
    read_detections,
    read_scenes_in_parts,
    read_tracks,
    read_truth,
)
from saga_fg.errors import InputError
from saga_fg.tables.column_names import ALIASES, canonical, meaning, pairs
from saga_fg.tables.units import FACTORS, Clock

T0 = 1_700_000_000
ROWS: list[dict[str, Any]] = [
    {"ts_ns": T0 * 10**9, "obj_class": "REGULAR_VEHICLE", "pos_x": 10.0, "pos_y": 2.0, "hdg_deg": 90.0, "conf": 0.9},
    {"ts_ns": T0 * 10**9, "obj_class": "SIGN", "pos_x": 30.0, "pos_y": 4.0, "hdg_deg": None, "conf": 0.5},
    {"ts_ns": T0 * 10**9 + 10**8, "obj_class": "SIGN", "pos_x": 30.0, "pos_y": 4.0, "hdg_deg": None, "conf": 0.6},
]


def write_csv(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_arrow(path: Path, rows: list[dict[str, Any]]) -> Path:
    pa = pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
    import pyarrow.feather
    import pyarrow.parquet

    table = pa.Table.from_pylist(rows)
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(table, path)
    else:
        pyarrow.feather.write_feather(table, path)
    return path


def table(folder: Path, rows: list[dict[str, Any]], suffix: str = ".csv") -> Path:
    return (write_csv if suffix == ".csv" else write_arrow)(folder / f"drive{suffix}", rows)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".feather"])
def test_usual_names_and_units_at_their_ends_are_understood(tmp_path, suffix):
    first, second = read_detections(table(tmp_path, ROWS, suffix)).scene("drive").frames
    assert (first.timestamp, second.timestamp) == (T0, pytest.approx(T0 + 0.1, abs=1e-6))
    car, sign = first.detections
    assert (car.label, car.position, car.score) == ("REGULAR_VEHICLE", (10.0, 2.0, 0.0), 0.9)
    assert car.yaw == pytest.approx(np.pi / 2)
    assert np.isnan(sign.yaw)


def test_a_named_column_that_lacks_is_an_error_also_where_it_is_of_tracks(tmp_path):
    path = tmp_path / "found.csv"
    path.write_text("timestamp,x,y\n0,1,2\n")
    with pytest.raises(InputError, match="--columns id=object_no: there is no column 'object_no'"):
        read_detections(path, TableImport(columns={"id": "object_no"}))


def test_classes_are_renamed_and_left_out_and_their_frames_stay(tmp_path):
    how = TableImport(classes={"REGULAR_VEHICLE": "car", "SIGN": ""})
    for suffix in (".csv", ".parquet"):
        frames = read_detections(table(tmp_path, ROWS, suffix), how).scene("drive").frames
        assert [frame.detections.boxes.label.tolist() for frame in frames] == [["car"], []]


def test_values_may_be_separated_by_other_signs(tmp_path):
    path = tmp_path / "drive.csv"
    for separator in ",;\t":
        path.write_text("time,x,y\n0,1,2\n".replace(",", separator), encoding="utf-8-sig")
        assert read_detections(path).scene("drive").frames[0].detections[0].position == (1.0, 2.0, 0.0)


def test_columns_that_are_named_win_and_may_be_left_out(tmp_path):
    path = table(tmp_path, [{"time": 1, "x": 1, "y": 2, "weird": 7, "length": 3, "width": 4}])
    how = TableImport(columns={"x": "weird", "length": "width", "width": "length", "score": ""})
    (found,) = read_detections(path, how).scene("drive").frames[0].detections
    assert (found.position[0], found.size[:2]) == (7.0, (4.0, 3.0))
    path = table(tmp_path, [{"time": 1, "x": 1, "y": 2, "var_x": 7, "both": 1, "var_y": 5}])
    how = TableImport(columns={"cov_xx": "var_x", "cov_xy": "both", "cov_yy": "var_y"})
    with_covariance = read_detections(path, how).scene("drive").frames[0].detections
    assert with_covariance.position_covariance.tolist() == [[[7, 1], [1, 5]]]


def test_all_columns_that_are_wrong_are_named_at_once(tmp_path):
    path = table(tmp_path, [{"when": 1, "pos_x": 1, "cx": 2, "lenght": 4}])
    with pytest.raises(InputError) as caught:
        read_detections(path, TableImport(columns={"score": "sure"}))
    text = str(caught.value)
    assert "\n" not in text
    for part in (
        "expected a column 'timestamp' and a column 'y', the columns there are cx, lenght, pos_x, when",
        "name it: --columns timestamp=NAME,y=NAME",
        "--columns score=sure: there is no column 'sure'",
        "x: expected one column, 'cx' or 'pos_x' could be it",
        "unknown column 'lenght'; did you mean 'length'? "
        "(--columns length=lenght, or --columns length= if it is another)",
    ):
        assert part in text


def test_all_values_that_are_wrong_are_named_at_once_by_the_files_names(tmp_path):
    path = table(tmp_path, [{"t": 0, "pos_x": "far", "pos_y": 1, "conf": "high"}])
    with pytest.raises(InputError) as caught:
        read_detections(path)
    assert "line 2: x (column 'pos_x'): expected a number, got 'far'" in str(caught.value)
    assert "line 2: score (column 'conf'): expected a number, got 'high'" in str(caught.value)


def test_the_clock_is_found_by_what_times_look_like(tmp_path, subtests):
    for times, seconds in (
        ([0, 0.1, 0.2], [0, 0.1, 0.2]),
        ([10**11 * 5, 10**11 * 5 + 10**8], [500, 500.1]),  # ns since the start, of 500 s
        (["2023-11-14T22:13:20Z", "2023-11-14T22:13:20.100"], [T0, T0 + 0.1]),
        (["2023-11-15 00:13:20+02:00"], [T0]),
    ):
        with subtests.test(times=times):
            path = table(tmp_path, [{"time": time, "x": 1, "y": 2} for time in times])
            np.testing.assert_allclose(read_detections(path).scene("drive").timestamps, seconds, atol=1e-6)


def test_a_clock_that_is_guessed_is_told(tmp_path, caplog):
    path = table(tmp_path, [{"time": T0 * 1000, "x": 1, "y": 2}])
    read_detections(path)
    assert "times are read as milliseconds, by their size; --units time=ms says so" in caplog.text
    caplog.clear()
    read_detections(path, TableImport(units={"time": "ms"}))
    assert not caplog.records


def test_dates_are_times_if_they_can_be(tmp_path):
    rows = [{"time": datetime(2023, 11, 14, 22, 13, 20, k * 100_000, UTC), "x": 1.0, "y": 2.0} for k in range(2)]
    times = read_detections(table(tmp_path, rows, ".parquet")).scene("drive").timestamps
    np.testing.assert_allclose(times, [T0, T0 + 0.1], atol=1e-6)
    path = table(tmp_path, [{"time": time, "x": 1, "y": 2} for time in ("2023-11-14T22:13:20", "later")])
    with pytest.raises(InputError, match=r"line 3: timestamp \(column 'time'\): expected a date and time of ISO 8601"):
        read_detections(path)
    path = tmp_path / "numbers.ndjson"
    path.write_text('{"time": "2023-11-14T22:13:20", "x": 1, "y": 2}\n{"time": 5, "x": 1, "y": 2}\n')
    with pytest.raises(InputError, match=r"line 2: timestamp .* expected a date and time of ISO 8601, got '5'"):
        read_detections(path)


def test_units_that_are_given(tmp_path):
    rows = [{"frame_no": k, "x": 10, "y": 20, "length": 15, "vx": 36, "yaw": 180, "score": 50} for k in (0, 5)]
    units = {"time": "10Hz", "length": "ft", "speed": "km/h", "angle": "deg", "score": "percent"}
    first, last = read_detections(
        table(tmp_path, [{**row, "vy": 0} for row in rows]), TableImport(columns={"time": "frame_no"}, units=units)
    ).scene("drive").frames  # fmt: skip
    (found,) = first.detections
    assert last.timestamp == 0.5
    assert found.position[:2] == pytest.approx((3.048, 6.096))
    assert found.size[0] == pytest.approx(4.572)
    assert found.velocity[0] == pytest.approx(10.0)
    assert abs(found.yaw) == pytest.approx(np.pi)
    assert found.score == 0.5


@given(st.floats(-3.1, 3.1), st.floats(0.995, 1.005))
def test_a_quaternion_is_a_heading(tmp_path_factory, yaw, norm):
    w, z = np.cos(yaw / 2) * norm, np.sin(yaw / 2) * norm
    path = table(
        tmp_path_factory.mktemp("q"), [{"t": 0, "x": 1, "y": 2, "qw": float(w), "qx": 0, "qy": 0, "qz": float(z)}]
    )
    (found,) = read_detections(path).scene("drive").frames[0].detections
    assert found.yaw == pytest.approx(yaw, abs=1e-6)


def test_a_quaternion_that_is_none_is_named(tmp_path):
    path = table(tmp_path, [{"t": 0, "x": 1, "y": 2, "qw": 1, "qx": 1, "qy": 0, "qz": 0}])
    with pytest.raises(InputError, match=r"line 2: qw qx qy qz: expected a quaternion of length 1, got 1\.41421"):
        read_detections(path)
    path = table(tmp_path, [{"t": 0, "x": 1, "y": 2, "rotation_z": 1}])
    with pytest.raises(InputError, match="qy qz with it; if it is the heading: --columns yaw=rotation_z"):
        read_detections(path)
    turned = TableImport(columns={"yaw": "rotation_z"})
    assert read_detections(path, turned).scene("drive").frames[0].detections[0].yaw == 1


def test_rows_are_sorted_by_time_where_asked(tmp_path):
    path = table(tmp_path, [{"t": t, "x": t, "y": 0, "length": s} for t, s in ((2, 1), (0, 2), (1, -3))])
    with pytest.raises(InputError, match=r"time runs backwards at 0\.0 s; --sort sorts them"):
        read_detections(path, TableImport(columns={"length": ""}))
    how = TableImport(columns={"length": ""}, sort=True)
    assert [f.detections[0].position[0] for f in read_detections(path, how).scene("drive").frames] == [0, 1, 2]
    assert [scene.timestamps.tolist() for scene in read_scenes_in_parts(path, 1, how=how)] == [[0, 1, 2]]
    with pytest.raises(InputError, match="line 4: length: expected a positive number"):
        read_detections(path, TableImport(sort=True))


def test_parts_are_cut_between_moments_and_coordinates_given_for_rows_that_say_none(tmp_path):
    path = tmp_path / "drive.ndjson"
    path.write_text("".join(f'{{"ts": {k // 2}, "pos_x": {k}, "pos_y": 0}}\n' for k in range(8)))
    assert [len(scene) for scene in read_scenes_in_parts(path, 3)] == [2, 2]
    path = table(tmp_path, [{"t": 0, "x": 1, "y": 2, "ego_x": 5, "ego_y": 6, "ego_yaw": 0}])
    assert read_detections(path, TableImport(coordinates="ego")).scene("drive").frames[0].coordinates == "ego"


def test_anybodys_tracks_and_our_own(tmp_path):
    rows = [{"time_ms": 100, "track_uuid": "a-1", "type": "CAR", "cx": 1, "cy": 2}]
    tracks = read_tracks(table(tmp_path, rows), TableImport(classes={"CAR": "car"}))
    assert (tracks.timestamp.tolist(), tracks.id.tolist(), tracks.boxes.label.tolist()) == ([0.1], ["a-1"], ["car"])
    rows = [{"t": 0, "id": 7, "x": 1.0, "y": 2.0}, {"t": 1, "id": 8, "x": 1.0, "y": 2.0}]
    assert read_tracks(table(tmp_path, rows, ".parquet")).id.tolist() == ["7", "8"]
    row = {"timestamp": 1, "id": 1, "label": "car", "x": 1, "y": 2, "yaw": 1, "cov_xx": 1, "coasting": 0}
    tracks = read_tracks(table(tmp_path, [row]), TableImport(units={"angle": "deg", "time": "ms"}))
    assert (tracks.timestamp.tolist(), tracks.boxes.yaw.tolist()) == ([1.0], [1.0])


def test_true_objects(tmp_path):
    rows = [
        {"t": k, "uuid": name, "x": 2.0 * k, "y": 0, "visible": shown, "coordinates": "ego"} | EGO
        for k in range(3)
        for name, shown in (("a", 1), ("b", 0))
    ]
    scene = read_truth(table(tmp_path, rows)).scene("drive")
    first = scene.ground_truth[0]
    assert first.id.tolist() == ["a", "b"]
    assert first.visible.tolist() == [True, False]
    np.testing.assert_allclose(first.boxes.position[0], [5, 6, 0])
    np.testing.assert_allclose(first.boxes.velocity, [[0, 2], [0, 2]], atol=1e-9)  # the vehicle looks north


EGO = {"ego_x": 5, "ego_y": 6, "ego_yaw": np.pi / 2}


def test_every_alias_has_one_meaning():
    aliases = [alias for names in ALIASES.values() for alias in names]
    assert len(aliases) == len(set(aliases))
    for ours, names in ALIASES.items():
        assert all(canonical(name.upper().replace("_", " ")) == ours for name in names), ours
    assert meaning("Pos X [m]") == ("x", "m")
    assert meaning("vel_x_kmh") == ("vx", "km/h")
    assert meaning("pos_x_deg") is None


@given(st.sampled_from([unit for unit in FACTORS["time"] if unit != "s"]), st.floats(0.02, 2.0))
def test_times_since_1970_are_known_in_any_unit(unit, step):
    times = (T0 + step * np.arange(20)) / FACTORS["time"][unit]
    assert Clock.fitting(times).unit == unit


def test_ways_of_reading_that_do_not_exist(subtests):
    for values, message in [
        ({"columns": {"lenghth": "l"}}, "columns.lenghth: unknown column, did you mean 'length'?"),
        ({"units": {"time": "minutes"}}, "time: expected one of s, ms, us, ns, iso8601"),
        ({"units": {"weight": "kg"}}, "units.weight: expected one of time, length"),
        ({"coordinates": "map"}, "coordinates: expected one of world, ego, sensor, camera, got 'map'"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message.replace("?", r"\?")):
            TableImport(**values)


def test_the_options_say_what_the_settings_say():
    how = TableImport({"time": "my ts"}, {"A": "car"}, {"angle": "degrees"}, "ego", True)
    assert how.options() == " --columns 'timestamp=my ts' --classes A=car --units angle=deg --coordinates ego --sort"
    assert TableImport(**how.values()) == how
    assert pairs("--columns", " a = b ,c=") == {"a": "b", "c": ""}
    with pytest.raises(InputError, match="--columns: expected NAME=VALUE with commas between them, got 'x'"):
        pairs("--columns", "x")
    with pytest.raises(InputError, match="expected 'a' once"):
        pairs("--columns", "a=1,a=2")
