"""The tracker and time: several sensors at irregular times, late frames, and looking ahead without a trace."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from tests.saga_fg.traffic_frames import columns, frame, run, seen, straight

FAST = straight([(0.0, 0.0), (-25.0, 4.0)], [(20.0, 0.0), (22.0, 0.0)])
SENSORS = {
    "lidar": Sensor(noise={"default": NoiseModel(position=0.4)}),
    "camera": Sensor(noise={"default": NoiseModel(position=0.2)}),
}


def tracker(**overall):
    classes = {"default": ClassSettings(motion=ConstantVelocity(1.0), initial_speed_deviation=15.0, gate=1 - 1e-7)}
    return Tracker(TrackerSettings(classes, edges=(), **overall), SENSORS)


def in_order(frames):
    return sorted(frames, key=lambda f: f.timestamp)


def jittered(rng, start, end, interval):
    times = np.arange(start, end, interval)
    return times + rng.uniform(-0.4, 0.4, len(times)) * interval


def error(tracks, truth):
    """Largest distance of a track from its object at the tracks' time."""
    return float(np.hypot(*(tracks.boxes.position[:, :2] - truth(tracks.timestamp)).T).max())


# several sensors


def test_sensors_at_their_own_irregular_times_feed_the_same_tracks():
    alone, together = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        lidar = seen(rng, FAST, jittered(rng, 0.0, 3.0, 0.1), noise=0.4)
        camera = seen(rng, FAST, jittered(rng, 0.05, 3.0, 0.083), noise=0.2, sensor="camera")
        both = tracker()
        last = run(both, in_order([*lidar, *camera]))[-1]
        assert last.id.tolist() == [1, 2]
        one = tracker()
        run(one, lidar)
        alone.append(error(one.tracks(3.0), FAST))
        together.append(error(both.tracks(3.0), FAST))
    assert np.mean(together) < 0.8 * np.mean(alone)


def test_how_often_somebody_looks_does_not_change_where_things_are():
    """Empty frames of a sensor that sees nothing are steps in between, and no more than that."""
    truth = straight([(0, 0), (-15, 0), (-30, 0)], [(10, 0), (11, 0), (10, 0)])
    frames = seen(np.random.default_rng(0), truth, np.arange(0, 3, 0.5), velocity=(10.0, 0.0))
    blind = {"default": Sensor(), "blind": Sensor(detection_probability=0.0)}
    with_steps = in_order([*frames, *(frame(t, [], "blind") for t in np.arange(0.05, 2.5, 0.1))])
    for edges, tolerance in (((), 1e-9), (TrackerSettings().edges, 0.02)):
        few, many = Tracker(TrackerSettings(edges=edges), blind), Tracker(TrackerSettings(edges=edges), blind)
        run(few, frames)
        run(many, with_steps)
        a, b = few.tracks(3.0), many.tracks(3.0)
        assert a.id.tolist() == b.id.tolist()
        assert b.boxes.position == pytest.approx(a.boxes.position, abs=tolerance)
        # headings turn with velocities from step to step, which correlates x and y by a millionth of their variances
        assert b.position_covariance == pytest.approx(a.position_covariance, rel=0.05, abs=1e-5)


def test_two_sensors_at_the_same_instant():
    both = tracker()
    both.step(frame(0.0, [(0, 0)], "lidar"))
    tracks = both.step(frame(0.0, [(0.2, 0)], "camera"))
    assert tracks.id.tolist() == [1]
    assert tracks.boxes.position[0, 0] == pytest.approx(0.2 * 0.4**2 / (0.4**2 + 0.2**2))


def test_a_sensors_clock_offset():
    behind = Tracker(TrackerSettings(edges=()), {"camera": Sensor(time_offset=-0.1), "lidar": Sensor()})
    tracks = behind.step(frame(1.1, [(0, 0)], "camera"))
    assert tracks.timestamp == pytest.approx(1.0)
    assert behind.step(frame(1.05, [(0, 0)], "lidar")).timestamp == pytest.approx(1.05)
    assert behind.late_frames == 0


# late frames


def with_late_camera(rng, delay):
    """Frames in order of time; and the same in order of arrival, the camera's `delay` s after their time."""
    lidar = seen(rng, FAST, np.arange(0.0, 2.5, 0.1), noise=0.4)
    camera = seen(rng, FAST, np.arange(0.04, 2.4, 0.1), noise=0.2, sensor="camera")
    arrival = sorted([(f.timestamp, f) for f in lidar] + [(f.timestamp + delay, f) for f in camera], key=lambda a: a[0])
    return in_order([*lidar, *camera]), [f for _, f in arrival], lidar


@pytest.mark.parametrize("delay", [0.07, 0.25])
def test_late_frames_help_nearly_as_if_they_had_come_in_time(delay):
    in_time, late, without = [], [], []
    for seed in range(12):
        ordered, arriving, lidar = with_late_camera(np.random.default_rng(seed), delay)
        for errors, frames in ((in_time, ordered), (late, arriving), (without, lidar)):
            t = tracker()
            history = run(t, frames)
            assert {k for tracks in history for k in tracks.id.tolist()} == {1, 2}, "an object was taken for another"
            assert t.late_frames == 0
            errors.append(error(t.tracks(2.5), FAST))
    assert np.mean(late) < 0.9 * np.mean(without)
    assert np.mean(late) < np.mean(in_time) + 0.3 * (np.mean(without) - np.mean(in_time))


def test_a_late_frame_finds_an_object_where_it_was():
    t = tracker()
    run(t, seen(np.random.default_rng(0), FAST, np.arange(0, 2, 0.1), noise=0.05))
    before = t.tracks(1.9)
    after = t.step(frame(1.6, FAST(1.6), "camera"))
    assert after.timestamp == pytest.approx(1.9)
    assert after.id.tolist() == [1, 2]
    assert after.boxes.position[:, :2] == pytest.approx(FAST(1.9), abs=0.3)
    assert (
        np.trace(after.position_covariance, axis1=1, axis2=2) < np.trace(before.position_covariance, axis1=1, axis2=2)
    ).all()
    assert after.coasting == pytest.approx([0.0, 0.0])


def test_an_object_that_only_a_late_frame_has_seen_has_moved_on_since():
    t = tracker()
    t.step(frame(1.0, [(50, 50)]))
    tracks = t.step(frame(0.7, [(0, 0)], "camera", velocity=(20.0, 0.0)))
    new = tracks.select(tracks.id == 2)
    assert new.boxes.position[0, :2] == pytest.approx([6.0, 0.0])
    assert new.coasting == pytest.approx([0.3])
    assert new.position_covariance[0, 0, 0] == pytest.approx(0.2**2 + (0.3 * 1.0) ** 2 + 1.0 * 0.3**3 / 3)


def test_a_late_frame_does_not_make_a_coasting_track_fresh():
    t = tracker()
    run(t, [frame(0.0, [(0, 0)]), frame(0.1, [(0, 0)]), frame(0.5, [])])
    assert t.step(frame(0.3, [(0, 0)], "camera")).coasting == pytest.approx([0.2])


def test_frames_that_come_too_late_are_left_out_and_counted():
    t = tracker(max_delay=0.5)
    run(t, [frame(k / 10, [(k, 0)], velocity=(10.0, 0.0)) for k in range(11)])
    before = columns(t.tracks(1.0))
    reported = t.step(frame(0.4, [(100, 100)], "camera"))
    assert columns(reported) == before
    assert columns(t.tracks(1.0)) == before
    assert t.late_frames == 1
    assert t.step(frame(0.6, [(100, 100)], "camera", velocity=(0.0, 0.0))).id.tolist() == [1, 2]
    assert t.late_frames == 1
    t.step(frame(0.6, [(-100, 100)], "camera"))  # may be anywhere by now, and is not reported
    assert t.assignment.id.tolist() == t.snapshot().table.id[-1:].tolist() == [3]


def test_no_delay_is_allowed_if_so_set():
    t = tracker(max_delay=0.0)
    run(t, [frame(1.0, [(0, 0)]), frame(1.0, [(0, 0)], "camera"), frame(0.99, [(0, 0)])])
    assert t.late_frames == 1


# looking ahead


def test_looking_ahead_moves_tracks_by_their_velocity_and_makes_them_less_certain():
    t = tracker()
    now = run(t, seen(np.random.default_rng(0), FAST, np.arange(0, 2, 0.1)))[-1]
    ahead = t.tracks(now.timestamp + 0.5)
    assert ahead.timestamp == now.timestamp + 0.5
    assert ahead.id.tolist() == now.id.tolist()
    assert ahead.boxes.position[:, :2] == pytest.approx(now.boxes.position[:, :2] + 0.5 * now.boxes.velocity)
    assert ahead.boxes.velocity == pytest.approx(now.boxes.velocity)
    assert (ahead.position_covariance[:, 0, 0] > now.position_covariance[:, 0, 0]).all()
    assert ahead.coasting == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("edges", [(), TrackerSettings().edges], ids=["independent", "graph"])
def test_looking_ahead_leaves_no_trace(edges):
    """Later output is the same to the last bit, however often somebody looked."""
    frames = seen(np.random.default_rng(2), FAST, np.arange(0, 3, 0.1), velocity=(20.0, 0.0))
    silent, watched = Tracker(TrackerSettings(edges=edges)), Tracker(TrackerSettings(edges=edges))
    for k, f in enumerate(frames):
        expected, got = silent.step(f), watched.step(f)
        assert columns(got) == columns(expected)
        graph = watched.graph
        for ahead in (0.0, 0.03, 1.7, 500.0, -0.4):
            watched.tracks(f.timestamp + ahead)
        assert columns(watched.tracks(f.timestamp)) == columns(expected)
        assert watched.graph is graph, k


def test_looking_back_gives_the_present():
    t = tracker()
    now = run(t, seen(np.random.default_rng(0), FAST, np.arange(0, 1, 0.1)))[-1]
    past = t.tracks(0.2)
    assert past.timestamp == 0.2
    assert past.boxes.position.tolist() == now.boxes.position.tolist()


def test_before_the_first_frame_there_is_nothing():
    assert len(Tracker().tracks(3.0)) == 0
    assert Tracker().tracks(3.0).timestamp == 3.0


def test_a_time_that_is_none_is_refused_and_nothing_has_happened(subtests):
    for timestamp in [np.nan, np.inf, -np.inf]:
        with subtests.test(timestamp=timestamp):
            t = tracker()
            now = run(t, seen(np.random.default_rng(0), FAST, np.arange(0, 1, 0.1)))[-1]
            with pytest.raises(InputError, match="timestamp: expected a finite number of seconds"):
                t.tracks(timestamp)
            assert columns(t.tracks(now.timestamp)) == columns(now)
            assert t.step(frame(1.0, FAST(1.0))).id.tolist() == [1, 2]
