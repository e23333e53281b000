"""Tables of pandas, Polars and Arrow in and out, and the one-line tracker."""

import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

import saga_fg
from saga_fg import Detection, Detections, Frame, InputError, MissingExtraError, TableImport, Tracker, Tracks
from saga_fg.tables.detections import frames_of

pd = pytest.importorskip("pandas", reason="pandas comes with the extra pandas")


def table(**more):
    rows = [{"timestamp": k / 10, "x": 1.0 * k - 12 * n, "y": 0.5 * n} for k in range(12) for n in range(2)]
    return pd.DataFrame(rows).assign(**more)


def test_all_columns_become_detections():
    rows = pd.DataFrame(
        {
            "x": [1.0, 2.0], "y": [3.0, 4.0], "z": [0.5, None], "length": [4.0, None], "width": [2.0, 1.0],
            "height": [1.5, 1.6], "yaw": [0.1, np.nan], "vx": [5.0, None], "vy": [0.0, None], "range_rate": [1.0, None],
            "cov_xx": [0.4, 1.0], "cov_xy": [0.1, 0.0], "cov_yy": [0.3, 2.0],
            "confidence": [0.7, 0.8], "class": ["car", "truck"], "colour": ["red", "blue"],
        }
    )  # fmt: skip
    found = frames_of(rows.assign(timestamp=1.0, ego_x=0.0, ego_y=0.0, ego_yaw=0.0))[0].detections
    assert found[0] == Detection(
        "car", (1.0, 3.0, 0.5), (4.0, 2.0, 1.5), found.boxes.yaw[0], (5.0, 0.0), 0.7, 1.0, (0.4, 0.1, 0.3)
    )
    assert found.boxes.label.tolist() == ["car", "truck"]
    assert found.boxes.position[1].tolist() == [2.0, 4.0, 0.0]
    assert np.isnan(found.boxes.velocity[1]).all()
    assert found.score.tolist() == [0.7, 0.8]
    assert frames_of(rows.assign(timestamp=1.0)[:0]) == []


def test_frames_come_in_order_of_time_and_by_sensor():
    rows = table(sensor=["lidar", "camera"] * 12).sample(frac=1, random_state=1)
    found = frames_of(rows)
    assert len(found) == 24
    assert [frame.timestamp for frame in found] == sorted(frame.timestamp for frame in found)
    assert {frame.sensor for frame in found} == {"lidar", "camera"}
    assert all(len(frame) == 1 for frame in found)


def test_dates_are_seconds_and_rows_without_a_place_moments():
    start = pd.Timestamp("2024-05-01 12:00:00")
    for unit in ("s", "ns"):
        times = table().assign(timestamp=lambda t: (start + pd.to_timedelta(t.timestamp, unit="s")).dt.round("100ms"))
        if unit == "ns":
            times["timestamp"] = times.timestamp.astype("datetime64[ns]")
        assert frames_of(times)[0].timestamp == pytest.approx(start.timestamp())
    elapsed = table().assign(timestamp=lambda t: pd.to_timedelta(t.timestamp, unit="s"))
    assert [f.timestamp for f in frames_of(elapsed)] == pytest.approx([f.timestamp for f in frames_of(table())])
    rows = pd.concat([table(), pd.DataFrame({"timestamp": [5.0], "x": [None], "y": [None]})])
    last = frames_of(rows)[-1]
    assert (last.timestamp, len(last)) == (5.0, 0)


def test_tables_of_polars_and_arrow_give_the_same_tracks_as_tables_of_their_kind():
    rows = table(label="car", yaw=[0.1, None] * 12)
    expected = saga_fg.track(rows)
    for kind, made in (
        ("pyarrow", lambda rows: pytest.importorskip("pyarrow").Table.from_pandas(rows)),
        ("polars", lambda rows: pytest.importorskip("polars").DataFrame(rows.to_dict("list"))),
    ):
        tracks = saga_fg.track(made(rows))
        assert type(tracks).__module__.startswith(kind)
        pd.testing.assert_frame_equal(tracks.to_pandas(), expected, check_dtype=False)


def test_each_scene_has_a_tracker_of_its_own():
    rows = pd.concat([table(label="car", scene=name) for name in ("first", "second")])
    tracks = saga_fg.track(rows)
    for _, of_scene in tracks.groupby("scene"):
        alone = of_scene.drop(columns="scene").reset_index(drop=True)
        pd.testing.assert_frame_equal(alone, saga_fg.track(table(label="car")))


def test_tables_are_read_as_the_arguments_say():
    rows = table(label="car", yaw=0.1, vx=10.0, vy=0.0)
    expected = saga_fg.track(rows)
    foreign = pd.DataFrame(
        {
            "ts": (1e3 * rows.timestamp).round(), "east": 100 * rows.x, "north": 100 * rows.y, "label": "PKW",
            "yaw": np.degrees(0.1), "vx": 36.0, "vy": 0.0,
        }
    )  # fmt: skip
    tracks = saga_fg.track(
        foreign,
        how=TableImport(
            columns={"x": "east", "y": "north"},
            classes={"PKW": "car"},
            units={"time": "ms", "length": "cm", "angle": "deg", "speed": "km/h"},
        ),
    )
    pd.testing.assert_frame_equal(tracks, expected, rtol=1e-6, atol=1e-9)
    drive = 8.0 * rows.timestamp
    of_vehicle = rows.assign(ego_x=drive, ego_y=0.0, ego_yaw=0.0, x=rows.x - drive)
    pd.testing.assert_frame_equal(
        saga_fg.track(of_vehicle, how=TableImport(coordinates="ego")), expected, rtol=1e-6, atol=1e-9
    )
    of_camera = of_vehicle.assign(x=-of_vehicle.y, y=1.5, z=of_vehicle.x, yaw=-0.1 - np.pi / 2)
    found = saga_fg.track(of_camera.drop(columns=["vx", "vy"]), how=TableImport(coordinates="camera"))
    plain = saga_fg.track(rows.drop(columns=["vx", "vy"]))
    pd.testing.assert_frame_equal(found[["x", "y", "yaw"]], plain[["x", "y", "yaw"]], rtol=1e-6, atol=1e-9)


def test_a_vehicle_in_degrees_is_not_taken_for_one_of_other_coordinates():
    """A vehicle that turns sees parked cars; its heading alone is in degrees."""
    time = np.repeat(0.2 * np.arange(30), 3)
    yaw, place = 0.05 * time, np.column_stack([6.0 * time, 0.15 * time**2])
    cars = np.tile([[10.0, 6.0], [30.0, -5.0], [55.0, 12.0]], (30, 1)) - place
    ahead = np.cos(yaw) * cars[:, 0] + np.sin(yaw) * cars[:, 1]
    left = np.cos(yaw) * cars[:, 1] - np.sin(yaw) * cars[:, 0]
    rows = {"timestamp": time, "x": ahead, "y": left, "label": "car", "ego_x": place[:, 0], "ego_y": place[:, 1]}
    rows = pd.DataFrame({**rows, "ego_yaw": np.degrees(yaw + 1.0)})
    with pytest.raises(InputError, match=r"headings of the vehicle look like degrees.*'ego_yaw': 'deg'"):
        saga_fg.track(rows, how=TableImport(coordinates="ego"))


def test_a_table_is_tracked_in_one_line():
    tracks = saga_fg.track(table(label="car"))
    assert sorted(tracks.id.unique()) == [1, 2]
    assert tracks.timestamp.min() == pytest.approx(0.1)  # from the second detection on
    last = tracks[tracks.timestamp == tracks.timestamp.max()].set_index("id")
    assert last.vx.to_numpy() == pytest.approx([10, 10], abs=0.5)
    assert (last.cov_xx > 0).all()
    assert list(saga_fg.track(table()[:0]).columns) == list(tracks.columns)
    tracker = Tracker()
    for frame in frames_of(table(label="car")):
        now = tracker.step(frame)
    pd.testing.assert_frame_equal(now.to_pandas(), tracks[-2:].reset_index(drop=True))


def test_tables_that_cannot_be_used_are_refused(subtests):
    for rows, message in [
        ([1, 2], r"expected a table of pandas, Polars or Arrow, got list"),
        (pd.DataFrame({"t": [1.0], "x": [1.0]}), r"expected a column 'y', the columns there are t, x"),
        (pd.DataFrame({"timestamp": [1.0], "x": ["far"], "y": [1.0]}), r"row 0: x: expected a number, got 'far'"),
        (
            pd.DataFrame({"timestamp": [1, 2], "x": [0.5, "far"], "y": [1, 1]}),
            r"row 1: x: expected a number, got 'far'",
        ),
        (pd.DataFrame({"timestamp": [1e30], "x": [1.0], "y": [1.0]}), r"timestamp"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            saga_fg.track(rows)


def test_a_value_is_named_by_its_column_and_row(subtests):
    for column, value, message in [
        ("x", np.inf, r"^table: row 500: x: expected a finite number, got inf"),
        ("y", 1e12, r"^table: row 500: y: expected a finite number within 1e\+09, got 1e\+12"),
        ("width", -2.0, r"^table: row 500: width: expected a positive number of metres, got -2"),
        ("confidence", np.inf, r"^table: row 500: score \(column 'confidence'\): expected a finite number, got inf"),
        ("cov_xy", 3.0, r"^table: row 500: cov_xx, cov_xy, cov_yy: expected a positive definite matrix, got 1, 3, 1"),
    ]:
        with subtests.test(message):
            rows = table(label="car", width=1.8, confidence=0.5, cov_xx=1.0, cov_xy=0.0, cov_yy=1.0)
            rows.index = rows.index + 490
            rows.loc[500, column] = value
            with pytest.raises(InputError, match=message):
                saga_fg.track(rows)


def test_what_is_probably_wrong_is_warned_of(subtests):
    for columns, message in [
        ({"label": "car", "score": [-2.5, 3.0] * 12}, r'Sensor\(score="logit"\)'),
        (
            {"label": "REGULAR_VEHICLE"},
            r"no edges: tracker.edges act on .*car.*, and the tracks are of REGULAR_VEHICLE; .*; "
            r"add how=TableImport\(classes=\{'REGULAR_VEHICLE': 'car'\}\)",
        ),
    ]:
        with subtests.test(message), pytest.warns(UserWarning, match=message):
            saga_fg.track(table(**columns))


def test_a_table_that_contradicts_how_it_is_read_is_refused_with_what_mends_it(subtests):
    for columns, mend in [
        ({"score": 87.0}, {"units": {"score": "percent"}}),
        ({"yaw": 90.0, "vx": 0.0, "vy": 3.0}, {"units": {"angle": "deg"}}),
        ({"timestamp": 1e8 * np.arange(24)}, {"units": {"time": "ns"}}),
        ({"length": 180.0, "width": 71.0}, {"units": {"length": "cm"}}),
        ({"length": 1.8, "width": 4.5, "yaw": 0.0}, {"columns": {"length": "width", "width": "length"}}),
    ]:
        rows = table(label="car", **columns)
        wanted = ", ".join(f"{name}={value!r}" for name, value in mend.items())
        with subtests.test(wanted):
            given = "how=TableImport(as_given=True)"
            mended = f"; add how=TableImport({wanted}); {given} reads it as it is"
            with pytest.raises(InputError, match=re.escape(mended)):
                saga_fg.track(rows)
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                saga_fg.track(rows, how=TableImport(as_given=True))
            assert any(wanted in str(each.message) for each in told)
            if "length" not in str(mend):
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    saga_fg.track(rows, how=TableImport(**mend))


def test_headings_of_a_compass_are_refused_with_and_without_velocities():
    angle = np.linspace(0, 6, 60)
    x, y = 20 * np.sin(angle), -20 * np.cos(angle)
    turning = pd.DataFrame({"timestamp": angle / 0.5, "label": "car", "x": x, "y": y, "yaw": np.pi / 2 - angle})
    for rows in (turning, turning.assign(vx=10 * np.cos(angle), vy=10 * np.sin(angle))):
        message = r"headings look clockwise from north: .* add how=TableImport\(units=\{'angle': 'compass_rad'\}\)"
        with pytest.raises(InputError, match=message):
            saga_fg.track(rows)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            saga_fg.track(rows.assign(yaw=angle))


def test_usual_tables_are_not_warned_of():
    saga_fg.track(table(label=["car", "dog"] * 12, score=[0.0, 1.0] * 12, yaw=[6.28, -6.28] * 12))
    saga_fg.track(table(label="car", score=3.0), sensors={"default": saga_fg.Sensor(score="logit")})
    saga_fg.track(table())
    saga_fg.track(table(label="DRONE"), saga_fg.TrackerSettings(edges=(), min_hits=2))


def test_pandas_is_imported_when_asked_for_and_named_where_missing(monkeypatch):
    code = "import sys, saga_fg; saga_fg.track, saga_fg.Tracks; assert 'pandas' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'saga-fg\[pandas\]'"):
        Tracks.empty(0.0).to_pandas()


def test_notebooks_show_tables():
    many = Detections.of([Detection("<car>", (k, 2.0, 0.0)) for k in range(30)])
    shown = many._repr_html_()
    assert "30 detections" in shown
    assert "and 10 more" in shown
    assert "&lt;car&gt;" in shown
    assert "nan" not in shown
    tracker = Tracker()
    for k in range(3):
        tracks = tracker.step(Frame(k / 10, "lidar", many))
    assert f"{len(tracks)} tracks at 0.200 s" in tracks._repr_html_()


def test_tracks_and_detections_are_printed_as_tables_of_one_width():
    detections = Detections.concatenate(
        [frame.detections for frame in frames_of(table(label=["car", "pedestrian"] * 12))]
    )
    tracks = saga_fg.Tracker().step(saga_fg.Frame(0.0, "lidar", detections))
    for shown in (detections, tracks):
        title, *rows = str(shown).splitlines()
        assert title.startswith(f"{len(shown)} ")
        assert len({len(row) for row in rows if not row.startswith("and ")}) == 1
        assert "pedestrian" in str(shown)
        assert "nan" not in str(shown)


def test_a_tracker_says_what_it_holds():
    tracker = Tracker(saga_fg.TrackerSettings(min_hits=3), {"radar": saga_fg.Sensor()})
    assert repr(tracker).startswith("Tracker(0 tracks; ")
    tracker.step(Frame(1.5, "radar", Detections.of([Detection("car", (0.0, 0.0, 0.0))])))
    assert repr(tracker) == (
        "Tracker(1 tracks at 1.500 s; estimator kalman, 2 edge rules, sensors radar; changed: min_hits)"
    )
