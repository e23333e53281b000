"""Tables of pandas in and out, and the one-line tracker."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from saga_fg.types.pandas_tables import moments_of_table

import saga_fg
from saga_fg import Detection, Detections, Frame, InputError, MissingExtraError, Tracker, Tracks

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
    found = Detections.from_pandas(rows)
    assert found[0] == Detection(
        "car", (1.0, 3.0, 0.5), (4.0, 2.0, 1.5), found.boxes.yaw[0], (5.0, 0.0), 0.7, 1.0, (0.4, 0.1, 0.3)
    )
    assert found.boxes.label.tolist() == ["car", "truck"]
    assert found.boxes.position[1].tolist() == [2.0, 4.0, 0.0]
    assert np.isnan(found.boxes.velocity[1]).all()
    assert found.score.tolist() == [0.7, 0.8]
    assert len(Detections.from_pandas(rows[:0])) == 0


def test_frames_come_in_order_of_time_and_by_sensor():
    rows = table(sensor=["lidar", "camera"] * 12).sample(frac=1, random_state=1)
    moments = list(moments_of_table(rows))
    assert len(moments) == 24
    assert [time for time, _, _ in moments] == sorted(time for time, _, _ in moments)
    assert {sensor for _, sensor, _ in moments} == {"lidar", "camera"}
    assert all(len(found) == 1 for _, _, found in moments)


def test_times_of_pandas_are_seconds_and_rows_without_a_place_moments():
    start = pd.Timestamp("2024-05-01 12:00:00")
    for unit in ("s", "ns"):
        times = table().assign(timestamp=lambda t: (start + pd.to_timedelta(t.timestamp, unit="s")).dt.round("100ms"))
        if unit == "ns":
            times["timestamp"] = times.timestamp.astype("datetime64[ns]")
        first, *_ = next(moments_of_table(times))
        assert first == pytest.approx(start.timestamp())
    rows = pd.concat([table(), pd.DataFrame({"timestamp": [5.0], "x": [None], "y": [None]})])
    *_, (time, _, found) = moments_of_table(rows)
    assert (time, len(found)) == (5.0, 0)


def test_a_table_is_tracked_in_one_line():
    tracks = saga_fg.track(table(label="car"))
    assert sorted(tracks.id.unique()) == [1, 2]
    assert tracks.timestamp.min() == pytest.approx(0.1)  # from the second detection on
    last = tracks[tracks.timestamp == tracks.timestamp.max()].set_index("id")
    assert last.vx.to_numpy() == pytest.approx([10, 10], abs=0.5)
    assert (last.cov_xx > 0).all()
    assert list(saga_fg.track(table()[:0]).columns) == list(tracks.columns)
    tracker = Tracker()
    for time, sensor, rows in moments_of_table(table(label="car")):
        now = tracker.step(Frame(time, sensor, Detections.from_pandas(rows)))
    pd.testing.assert_frame_equal(now.to_pandas(), tracks[-2:].reset_index(drop=True))


def test_tables_that_cannot_be_used_are_refused(subtests):
    for rows, message in [
        ([1, 2], r"expected a pandas.DataFrame, got list"),
        (pd.DataFrame({"t": [1.0], "x": [1.0]}), r"expected the columns timestamp, y as well, there are t, x"),
        (pd.DataFrame({"timestamp": [1.0], "x": ["far"], "y": [1.0]}), r"x: expected numbers"),
        (pd.DataFrame({"timestamp": [1e15], "x": [1.0], "y": [1.0]}), r"timestamp"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            saga_fg.track(rows)


def test_a_value_is_named_by_its_column_and_row(subtests):
    for column, value, message in [
        ("x", np.inf, r"^x: row 500: expected a finite number of at most 1e\+09, got inf"),
        ("y", 1e12, r"^y: row 500: expected a finite number of at most 1e\+09, got 1e\+12|1000000000000"),
        (
            "width",
            -2.0,
            r"^width: row 500: expected a size above 0 m of at most 100000, or nothing for unknown, got -2",
        ),
        ("confidence", np.inf, r"^confidence: row 500: expected a finite number, or nothing for unknown, got inf"),
        ("cov_xy", 3.0, r"^cov_xx, cov_xy, cov_yy: row 500: expected a positive definite matrix, got 1.0, 3.0, 1.0"),
    ]:
        with subtests.test(message):
            rows = table(label="car", width=1.8, confidence=0.5, cov_xx=1.0, cov_xy=0.0, cov_yy=1.0)
            rows.index = rows.index + 490
            rows.loc[500, column] = value
            with pytest.raises(InputError, match=message):
                saga_fg.track(rows)


def test_what_is_probably_wrong_is_warned_of(subtests):
    for columns, message in [
        ({"label": "car", "score": 87.0}, r"scores are not from 0 to 1: 100% .* look like percent; expected 0 to 1"),
        ({"label": "car", "score": -2.5}, r'Sensor\(score="logit"\)'),
        ({"label": "car", "yaw": 90.0}, r"headings look like degrees: 100% .* the largest is 90; expected rad"),
        ({"label": "car", "timestamp": 1e8 * np.arange(24)}, r"frames are usually 1e\+08 s apart: .* look like ns"),
        ({"label": "car", "length": 180.0, "width": 71.0}, r"objects have a usual length of 180: this looks like cm"),
        (
            {"label": "REGULAR_VEHICLE"},
            r"no edges: tracker.edges act on .*car.*, and the tracks are of REGULAR_VEHICLE",
        ),
    ]:
        with subtests.test(message), pytest.warns(UserWarning, match=message):
            saga_fg.track(table(**columns))


def test_headings_of_a_compass_are_warned_of_with_and_without_velocities():
    angle = np.linspace(0, 6, 60)
    x, y = 20 * np.sin(angle), -20 * np.cos(angle)
    turning = pd.DataFrame({"timestamp": angle / 0.5, "label": "car", "x": x, "y": y, "yaw": np.pi / 2 - angle})
    for rows in (turning, turning.assign(vx=10 * np.cos(angle), vy=10 * np.sin(angle))):
        with pytest.warns(UserWarning, match="headings look clockwise from north: .* expected counter-clockwise"):
            saga_fg.track(rows)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            saga_fg.track(rows.assign(yaw=angle))


def test_usual_tables_are_not_warned_of():
    saga_fg.track(table(label=["car", "dog"] * 12, score=[0.0, 1.0] * 12, yaw=[6.28, -6.28] * 12))
    saga_fg.track(table(label="car", score=3.0), sensors={"default": saga_fg.Sensor(score="logit")})
    saga_fg.track(table())
    saga_fg.track(table(label="DRONE"), saga_fg.TrackerSettings(edges=()))


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
    detections = Detections.from_pandas(table(label=["car", "pedestrian"] * 12))
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
