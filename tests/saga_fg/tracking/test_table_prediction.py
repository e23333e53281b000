"""`saga_fg.predict`: where the tracks of a table will be, as the textbook says and as the edges do."""

import re
from dataclasses import replace

import numpy as np
import pytest

import saga_fg
from saga_fg import ConstantVelocity, InputError, Sensor, TableImport, Tracker, TrackerSettings
from saga_fg.estimators.reference import Gaussian, kalman_predict, kalman_update
from saga_fg.model import NoiseModel
from saga_fg.tracking import ClassSettings, plain_settings

pd = pytest.importorskip("pandas", reason="pandas comes with the extra pandas")
SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=0.2)})}
PLAIN = TrackerSettings(min_hits=2)


def traffic(until=4.0, **more):
    """A leader that brakes from 2 s on, its follower, hidden from 3 s on, and a pedestrian apart from them."""
    rng, rows = np.random.default_rng(5), []
    for t in np.arange(0, until, 0.1).round(1).tolist():
        lead = 12 * t - 1.5 * max(t - 2, 0) ** 2
        there = [("car", lead, 0.0), ("pedestrian", 5.0 + t, 60.0), *([("car", 12 * t - 14, 0.0)] if t <= 3 else [])]
        for label, x, y in there:
            x, y = rng.normal([x, y], 0.1)
            rows.append({"timestamp": t, "label": label, "x": x, "y": y})
    return pd.DataFrame(rows).assign(**more)


def motion(dt, density):
    """F and Q of constant velocity with white noise acceleration, for x, y, vx, vy (Bar-Shalom et al., 2001, 6.2.2)."""
    F, Q = np.array([[1, dt], [0, 1]]), density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.kron(F, np.eye(2)), np.kron(Q, np.eye(2))


def test_an_object_apart_is_predicted_as_the_textbook_says():
    rows = traffic()
    rows = rows[rows.label == "pedestrian"]
    settings = TrackerSettings(
        {"default": ClassSettings(ConstantVelocity(0.7), initial_speed_deviation=2.0)}, min_hits=2
    )
    z, H, R = rows[["x", "y"]].to_numpy(), np.eye(2, 4), 0.04 * np.eye(2)
    x = Gaussian(np.array([*z[0], 0, 0]), np.diag([0.04, 0.04, 4.0, 4.0]))
    F, Q = motion(0.1, 0.7)
    for measured in z[1:]:
        x, _ = kalman_update(kalman_predict(x, F, np.zeros(4), Q), measured, H, R)
    found = saga_fg.predict(rows, (0.5, 1.7, 3.0), settings=settings, sensors=SENSORS)
    assert found.timestamp.tolist() == pytest.approx([3.9] * 3)
    for row in found.itertuples():
        F, Q = motion(row.horizon, 0.7)
        expected = kalman_predict(x, F, np.zeros(4), Q)
        sigma = np.sqrt(np.diag(expected.covariance))
        apart = np.array([row.x, row.y, row.vx, row.vy]) - expected.mean
        assert np.abs(apart / sigma).max() < 1e-6
        of_table = [row.cov_xx, row.cov_xy, row.cov_yy, row.cov_vxvx, row.cov_vyvy]
        P = expected.covariance
        assert of_table == pytest.approx([P[0, 0], P[0, 1], P[1, 1], P[2, 2], P[3, 3]], rel=1e-6, abs=1e-9)


def test_a_follower_does_what_its_leader_does_with_edges_alone():
    rows = traffic()
    coupled = saga_fg.predict(rows, [3.0], settings=PLAIN).set_index("id")
    alone = saga_fg.predict(rows, [3.0], settings=TrackerSettings(edges=(), min_hits=2)).set_index("id")
    follower = coupled.loc[coupled.label == "car", "x"].idxmin()
    assert coupled.vx[follower] < alone.vx[follower] - 1.0
    assert coupled.cov_xx[follower] < alone.cov_xx[follower]
    walks = coupled.index[coupled.label == "pedestrian"]
    pd.testing.assert_frame_equal(coupled.loc[walks], alone.loc[walks], rtol=1e-6)


def test_nothing_after_a_time_changes_what_is_predicted_from_it():
    rows = traffic()
    times = [3.5, 1.0]
    found = saga_fg.predict(rows, [0.5, 2.0], times, settings=PLAIN)
    assert found.timestamp.unique().tolist() == [1.0, 3.5]
    for time, of_time in found.groupby("timestamp"):
        before = saga_fg.predict(rows[rows.timestamp <= time], [0.5, 2.0], settings=PLAIN)
        pd.testing.assert_frame_equal(of_time.reset_index(drop=True), before)
    between = saga_fg.predict(rows, [0.5], [1.04], settings=PLAIN).set_index("id")
    of_frame = saga_fg.predict(rows, [0.54], [1.0], settings=PLAIN).set_index("id")
    pd.testing.assert_frame_equal(between[["x", "vx", "cov_xx"]], of_frame[["x", "vx", "cov_xx"]], rtol=1e-6)


def test_the_tracks_are_those_of_track():
    rows = traffic(scene=["a", "b"] * 50 + ["a"] * (len(traffic()) - 100))
    now, found = saga_fg.track(rows), saga_fg.predict(rows, [0.0])
    for scene, of_scene in found.groupby("scene"):
        last = now[(now.scene == scene) & (now.timestamp == of_scene.timestamp.iloc[0])]
        assert of_scene.id.tolist() == last.id.tolist()
        assert of_scene.x.to_numpy() == pytest.approx(last.x.to_numpy())
    default = saga_fg.predict(rows)
    assert default.horizon.unique().tolist() == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]


@pytest.mark.parametrize("offset", [-0.04, 0.04])
def test_times_are_those_of_tracks_whatever_the_offset_of_the_sensor(offset):
    arguments = {"settings": PLAIN, "sensors": {"default": Sensor(time_offset=offset)}}
    tracks = saga_fg.track(traffic(2.0), **arguments)
    found = saga_fg.predict(traffic(2.0), [0.0], tracks.timestamp.unique()[-3:], **arguments)
    same = tracks[tracks.timestamp.isin(found.timestamp)]
    assert found.timestamp.nunique() == 3
    assert found[["timestamp", "id"]].to_numpy().tolist() == same[["timestamp", "id"]].to_numpy().tolist()
    assert found.x.to_numpy() == pytest.approx(same.x.to_numpy())
    latest = saga_fg.predict(traffic(2.0), [0.0], **arguments)
    pd.testing.assert_frame_equal(latest, found[found.timestamp == found.timestamp.max()].reset_index(drop=True))


def test_modes_have_the_mean_and_covariance_of_their_mixture():
    settings = TrackerSettings(edges=(), stationary_share=0.5, min_hits=2)
    rows = pd.DataFrame({"timestamp": np.repeat(np.arange(8) / 5, 2), "x": 0.0, "y": [0.0, 9.0] * 8})
    rows["x"] += np.where(rows.y > 0, 1.2 * rows.timestamp, 0.1 * np.sin(9 * rows.timestamp))
    arguments = {"settings": settings, "sensors": SENSORS}
    whole = saga_fg.predict(rows, [1.0, 3.0], **arguments).set_index(["horizon", "id"])
    modes = saga_fg.predict(rows, [1.0, 3.0], modes=True, **arguments)
    stands = modes[modes["mode"] == "stationary"]
    assert len(whole) == 4
    assert len(stands) >= 2
    assert stands[["vx", "vy", "cov_vxvx"]].eq(0).all(axis=None)
    for key, of_track in modes.groupby(["horizon", "id"]):
        w, x = of_track.probability.to_numpy(), of_track.x.to_numpy()
        assert w.sum() == pytest.approx(1, abs=1e-3)
        assert w @ x / w.sum() == pytest.approx(whole.x[key], abs=1e-3 * (1 + np.ptp(x)))
        variance = w @ (of_track.cov_xx.to_numpy() + (x - w @ x) ** 2)
        assert variance == pytest.approx(whole.cov_xx[key], rel=1e-2)
    without = saga_fg.predict(rows, [1.0], modes=True, settings=TrackerSettings(edges=(), min_hits=2))
    assert set(without["mode"]) == {"moving"}
    assert (without.probability == 1).all()


@pytest.mark.parametrize("kind", ["polars", "pyarrow"])
def test_other_tables_give_tables_of_their_kind(kind):
    module, rows = pytest.importorskip(kind), traffic(2.0)
    made = module.DataFrame(rows.to_dict("list")) if kind == "polars" else module.Table.from_pandas(rows)
    found = saga_fg.predict(made, [1.0], how=TableImport(columns={"x": "x"}))
    assert type(found).__module__.startswith(kind)
    pd.testing.assert_frame_equal(found.to_pandas(), saga_fg.predict(rows, [1.0]), check_dtype=False)


def test_predictions_of_a_tracker_are_shown_and_exported():
    tracker = Tracker(PLAIN)
    for frame in saga_fg.frames_of(traffic()):
        tracker.step(frame)
    found = tracker.predict([1.0, 2.0], since=4.4)
    assert (found.timestamp, found.times.tolist()) == (4.4, [5.4, 6.4])
    assert found.position == pytest.approx(tracker.predict([1.5, 2.5]).position, abs=1e-9)
    assert str(found).splitlines()[0] == "3 tracks, predicted from 4.400 s"
    assert len(str(found).splitlines()) == 2 + 6
    assert found._repr_html_().count("<tr>") == 1 + 6
    pd.testing.assert_frame_equal(found.to_pandas(), pd.DataFrame(found.table_columns()))


def test_what_cannot_be_predicted_is_named(subtests):
    rows = traffic(1.0)
    for arguments, message in [
        ({"horizons": [1.0, 0.5]}, "horizons: expected increasing seconds from 0 to 60"),
        ({"horizons": 1.0}, "horizons: expected a list of seconds"),
        ({"horizons": [61.0]}, "horizons: expected increasing seconds from 0 to 60"),
        ({"times": ["soon"]}, "times"),
        ({"times": 1.0}, "times: expected"),
        ({"times": [np.nan]}, "times[0]: expected a finite number, got nan"),
        ({"how": TableImport(columns={"x": "east"})}, "east"),
        ({"how": {"columns": {"x": "east"}}}, "how: expected TableImport, got dict"),
        ({"method": "centerpoint"}, "method: expected saga or kf, centerpoint predicts nothing"),
        ({"method": "sage"}, "method: expected one of saga, kf, centerpoint, got 'sage'"),
        ({"settings": "thin"}, "settings: expected plain, dense or TrackerSettings, got 'thin'"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=re.escape(message)):
            saga_fg.predict(rows, **arguments)
    with pytest.raises(InputError, match=re.escape("add how=TableImport(units={'time': 'ns'}); how=")):
        saga_fg.predict(rows.assign(timestamp=1e9 * rows.timestamp))
    none = saga_fg.predict(rows[:0], modes=True)
    assert len(none) == 0
    assert {"mode", "probability", "horizon", "cov_xx"} <= set(none.columns)
    for nothing in (saga_fg.predict(rows.assign(scene="a"), times=[]), saga_fg.track(rows[:0].assign(scene="a"))):
        assert (len(nothing), nothing.columns[0]) == (0, "scene")
    with pytest.raises(InputError, match="settings: expected TrackerSettings, got dict"):
        saga_fg.predict(rows, settings={"min_hits": 2})
    with pytest.raises(InputError, match=re.escape("sensors.lidar: expected Sensor, got float")):
        saga_fg.track(rows, sensors={"lidar": 0.2})


def test_settings_keep_what_fits_tables_where_they_say_nothing():
    rows, few = traffic(1.0), TrackerSettings(edges=())
    with pytest.warns(UserWarning, match="settings: min_hits is at its default, 1, where .* have 2: change what"):
        hasty = saga_fg.track(rows, settings=few)
    kept = saga_fg.track(rows, settings=replace(plain_settings(), edges=()))
    pd.testing.assert_frame_equal(kept, saga_fg.track(rows, settings=TrackerSettings(edges=(), min_hits=2)))
    assert len(hasty) > len(kept)


def test_times_from_which_nothing_is_predicted_are_left_out_and_named():
    """As `saga-fg track --predict` leaves them out."""
    rows = traffic(1.0)
    gap = pd.concat([rows, rows.assign(timestamp=rows.timestamp + 90)])
    expected = saga_fg.predict(gap, times=[0.5], settings=PLAIN)
    left_out = "times: expected seconds within a scene (0 to 90.9), at most 60 s from a frame to a horizon; left out: "
    with pytest.warns(UserWarning, match=re.escape(f"{left_out}-1, 80, 200")):
        found = saga_fg.predict(gap, times=[80.0, 0.5, 200.0, -1.0], settings=PLAIN)
    pd.testing.assert_frame_equal(found, expected)
    with pytest.warns(UserWarning, match=re.escape("within a scene (), ")):
        assert len(saga_fg.predict(rows[:0], times=[1.0])) == 0
