"""The tracker and time: several sensors at irregular times, late frames, looking ahead, and clocks that jump."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, GreedyTracker, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.clock import REMEMBERED, Clock
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


def error(tracks, truth):
    """Largest distance of a track from its object at the tracks' time."""
    return float(np.hypot(*(tracks.boxes.position[:, :2] - truth(tracks.timestamp)).T).max())


# several sensors


def test_sensors_have_offsets_and_may_speak_at_one_instant():
    both = tracker()
    both.step(frame(0.0, [(0, 0)], "lidar"))
    tracks = both.step(frame(0.0, [(0.2, 0)], "camera"))
    assert tracks.id.tolist() == [1]
    assert tracks.boxes.position[0, 0] == pytest.approx(0.2 * 0.4**2 / (0.4**2 + 0.2**2))
    behind = Tracker(TrackerSettings(edges=()), {"camera": Sensor(time_offset=-0.1), "lidar": Sensor()})
    tracks = behind.step(frame(1.1, [(0, 0)], "camera"))
    assert tracks.timestamp == pytest.approx(1.0)
    assert behind.step(frame(1.05, [(0, 0)], "lidar")).timestamp == pytest.approx(1.05)
    assert behind.late_frames == 0
    with pytest.raises(InputError, match="time_offset: expected a number from"):
        Sensor(time_offset=1e300)


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
    for seed in range(6):
        ordered, arriving, lidar = with_late_camera(np.random.default_rng(seed), delay)
        for errors, frames in ((in_time, ordered), (late, arriving), (without, lidar)):
            t = tracker()
            history = run(t, frames)
            assert {k for tracks in history for k in tracks.id.tolist()} == {1, 2}, "an object was taken for another"
            assert t.late_frames == 0
            errors.append(error(t.tracks(2.5), FAST))
    assert np.mean(late) < 0.9 * np.mean(without)
    assert np.mean(late) < np.mean(in_time) + 0.3 * (np.mean(without) - np.mean(in_time))


def test_an_object_that_only_a_late_frame_has_seen_has_moved_on_since():
    t = tracker()
    t.step(frame(1.0, [(50, 50)]))
    tracks = t.step(frame(0.7, [(0, 0)], "camera", velocity=(20.0, 0.0)))
    new = tracks.select(tracks.id == 2)
    assert new.boxes.position[0, :2] == pytest.approx([6.0, 0.0])
    assert new.coasting == pytest.approx([0.3])
    assert new.position_covariance[0, 0, 0] == pytest.approx(0.2**2 + (0.3 * 1.0) ** 2 + 1.0 * 0.3**3 / 3)


def test_late_frames_refresh_nothing_and_may_be_refused():
    t = tracker()
    run(t, [frame(0.0, [(0, 0)]), frame(0.1, [(0, 0)]), frame(0.5, [])])
    assert t.step(frame(0.3, [(0, 0)], "camera")).coasting == pytest.approx([0.2])
    t = tracker(max_delay=0.0)
    run(t, [frame(1.0, [(0, 0)]), frame(1.0, [(0, 0)], "camera"), frame(0.99, [(0, 0)])])
    assert t.late_frames == 1


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


# looking ahead


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


def test_looking_back_gives_the_present_and_before_it_nothing():
    t = tracker()
    now = run(t, seen(np.random.default_rng(0), FAST, np.arange(0, 1, 0.1)))[-1]
    past = t.tracks(0.2)
    assert past.timestamp == 0.2
    assert past.boxes.position.tolist() == now.boxes.position.tolist()
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


# The clock of trackers: one broken timestamp changes nothing, a clock that was set is followed

CARS = straight([(0.0, 0.0), (0.0, 8.0)], [(5.0, 0.0), (6.0, 0.0)])
MAKERS = {"kalman": Tracker, "centerpoint": GreedyTracker}  # a clock knows no estimators
ALL = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


def at(start, times):
    """Frames of the cars at `times` after a start, by a clock that shows `start` at 0."""
    return [frame(start + t, CARS(t)) for t in times]


def verdicts(tracker, frames):
    told = []
    for each in frames:
        tracker.step(each)
        told.append(tracker.time_verdict)
    return told


@ALL
def test_one_broken_timestamp_changes_nothing(make, subtests):
    for jump in [1e8, 1.7e9, 9.9e10, -1e8, 20.0]:
        with subtests.test(jump=jump):
            good, glitched = make(), make()
            times = np.arange(10) / 10
            run(good, at(100.0, times))
            run(glitched, at(100.0, times))
            assert verdicts(glitched, [frame(101.0 + jump, CARS(1.0))]) == ["unconfirmed"]
            later = at(100.0, 1.0 + times)
            for a, b in zip(run(good, later), run(glitched, later), strict=True):
                assert b.id.tolist() == a.id.tolist()
                assert b.boxes.position == pytest.approx(a.boxes.position, abs=1e-9)


@ALL
def test_a_clock_that_was_set_is_followed(make, subtests):
    """The clock jumps from seconds since boot to the epoch, and back."""
    for start in [1.7e9, 1e8, 3000.0, -5e8]:
        with subtests.test(start=start):
            tracker = make()
            run(tracker, at(10.0, np.arange(10) / 10))
            told = verdicts(tracker, at(start, np.arange(5) / 10))
            assert told == ["unconfirmed", "set_ahead" if start > 0 else "set_back", *["accepted"] * 3]
            tracks = tracker.step(frame(start + 0.5, CARS(0.5)))
            assert tracks.timestamp == start + 0.5
            assert tracks.id.tolist() == [3, 4], "those from before are not taken for these"
            assert tracks.boxes.position[:, :2] == pytest.approx(CARS(0.5), abs=0.5)


@ALL
def test_a_glitch_that_was_believed_is_corrected_by_a_run_of_late_frames(make):
    tracker = make()
    run(tracker, at(0.0, np.arange(10) / 10))
    assert verdicts(tracker, [frame(9.0, CARS(9.0))]) == ["accepted"], "a gap like this one may be"
    assert verdicts(tracker, at(0.0, 1.0 + np.arange(5) / 10)) == ["late", "late", "set_back", *["accepted"] * 2]
    assert tracker.tracks(1.4).boxes.position[:, :2] == pytest.approx(CARS(1.4), abs=0.5)


def test_a_frame_sent_twice_confirms_nothing():
    tracker = Tracker()
    run(tracker, at(0.0, np.arange(3) / 10))
    assert set(verdicts(tracker, [frame(500.0, CARS(0.3))] * 5)) == {"unconfirmed"}
    assert verdicts(tracker, [frame(500.0, CARS(0.3), sensor="camera")]) == ["unconfirmed"], "it was never in time"


@ALL
def test_slow_streams_lose_no_frame_and_those_that_become_slow_one(make):
    times = np.cumsum([0.0, 60.0, 58.0, 63.0, 40.0, 60.0])
    assert verdicts(make(), [frame(t, [(0.0, 0.0)]) for t in times]) == ["accepted", "set_ahead", *["accepted"] * 4]
    tracker = make()
    run(tracker, at(0.0, np.arange(10) / 10))
    told = verdicts(tracker, [frame(0.9 + 60.0 * k, [(0.0, 0.0)]) for k in range(1, 5)])
    assert told == ["unconfirmed", "set_ahead", "accepted", "accepted"]
    assert verdicts(tracker, [frame(241.0, [(0.0, 0.0)]), frame(271.0, [(0.0, 0.0)])])[1] == "unconfirmed"


@ALL
def test_after_a_single_frame_the_second_is_believed(make, subtests):
    for wrong in [5.0, 1e6, -1e6]:
        with subtests.test(wrong=wrong):
            tracker = make()
            tracker.step(frame(wrong, CARS(0.0)))
            told = verdicts(tracker, at(0.0, np.arange(4) / 10))
            assert told[2:] == (["set_back", "accepted"] if wrong == 5.0 else ["accepted"] * 2)


@ALL
def test_frames_that_are_sent_again_say_nothing_of_the_clock(make):
    """A client that has lost its connection doesn't know what arrived, and sends again."""
    tracker = make()
    frames = at(0.0, np.arange(30) / 10)
    run(tracker, frames)
    before = tracker.tracks(2.9).id.tolist()
    assert set(verdicts(tracker, frames[:8])) == {"late"}
    assert set(verdicts(tracker, [frame(0.123, CARS(0.123))] * 6)) == {"late"}
    assert tracker.tracks(2.9).id.tolist() == before


def test_how_far_the_clock_may_jump_can_be_set():
    for settings, expected in (
        (TrackerSettings(max_jump=100.0), "accepted"),
        (TrackerSettings(max_coasting=80.0), "accepted"),  # tracks live that long
        (TrackerSettings(max_jump=7.0), "unconfirmed"),
    ):
        tracker = Tracker(settings)
        run(tracker, [frame(-0.1, [(0, 0)]), frame(0.0, [(0, 0)])])
        assert verdicts(tracker, [frame(60.0, [(0, 0)])]) == [expected]


def test_names_of_sensors_without_end_are_not_remembered():
    clock = Clock()
    for k in range(3 * REMEMBERED):
        _, clock = clock.judged(0.1 * k, f"sensor {k}", 10.0, 0.5)
    assert len(clock.accepted) == REMEMBERED
    tracker = Tracker()
    for k in range(200):
        tracker.step(frame(0.1 * k, [(0, 0)], sensor=f"sensor {k}", label=f"class {k}"))
    assert len(tracker.snapshot().table.sensors.sensors) < 50
