"""The clock of trackers: one broken timestamp changes nothing, a clock that was set is followed."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg import GreedyTracker, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.clock import REMEMBERED, Clock
from tests.saga_fg.traffic_frames import columns, frame, run, seen, straight

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


def test_late_frames_in_a_burst_do_not_set_the_clock():
    tracker = Tracker(TrackerSettings())
    run(tracker, [frame(0.0, CARS(0.0), sensor="camera"), *at(0.0, np.arange(30) / 10)])
    before = columns(tracker.tracks(2.9))
    stalled = [frame(t, CARS(t), sensor="camera") for t in np.arange(1.0, 2.0, 0.05)]
    assert set(verdicts(tracker, stalled)) == {"late"}
    assert tracker.late_frames == len(stalled)
    assert columns(tracker.tracks(2.9)) == before


def test_a_sensor_whose_clock_is_wrong_does_not_set_that_of_the_others(subtests):
    for apart in [-5.0, -1000.0, 1000.0]:
        with subtests.test(apart=apart):
            tracker = Tracker(TrackerSettings())
            for t in np.arange(20) / 10:
                assert verdicts(tracker, [frame(t, CARS(t))]) == ["accepted"]
                two = [frame(apart + t + s, CARS(t), sensor="radar") for s in (0.0, 0.05)]
                assert set(verdicts(tracker, two)) <= {"late", "unconfirmed"}
            assert tracker.tracks(1.9).id.tolist() == [1, 2]


def test_a_frame_sent_twice_confirms_nothing():
    tracker = Tracker()
    run(tracker, at(0.0, np.arange(3) / 10))
    assert set(verdicts(tracker, [frame(500.0, CARS(0.3))] * 5)) == {"unconfirmed"}
    assert verdicts(tracker, [frame(500.0, CARS(0.3), sensor="camera")]) == ["unconfirmed"], "it was never in time"


@ALL
def test_a_slow_stream_loses_no_frame(make):
    times = np.cumsum([0.0, 60.0, 58.0, 63.0, 40.0, 60.0])
    assert verdicts(make(), [frame(t, [(0.0, 0.0)]) for t in times]) == ["accepted", "set_ahead", *["accepted"] * 4]


@ALL
def test_a_stream_that_becomes_slow_loses_one(make):
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


def test_tracks_that_outlive_a_jump_are_predicted():
    settings = TrackerSettings(
        {"default": ClassSettings(max_deviation=np.inf)}, max_coasting=np.inf, max_out_of_view=np.inf
    )
    tracker = Tracker(settings)
    run(tracker, at(0.0, np.arange(10) / 10))
    assert verdicts(tracker, [frame(20.0, []), frame(20.1, [])]) == ["unconfirmed", "set_ahead"]
    tracks = tracker.step(frame(20.2, []))
    assert tracks.id.tolist() == [1, 2]
    assert tracks.coasting == pytest.approx([19.3, 19.3])
    assert tracks.boxes.position[:, 0] == pytest.approx(CARS(20.2)[:, 0], abs=15.0)


def test_names_of_sensors_without_end_are_not_remembered():
    clock = Clock()
    for k in range(3 * REMEMBERED):
        _, clock = clock.judged(0.1 * k, f"sensor {k}", 10.0, 0.5)
    assert len(clock.accepted) == REMEMBERED
    tracker = Tracker()
    for k in range(200):
        tracker.step(frame(0.1 * k, [(0, 0)], sensor=f"sensor {k}", label=f"class {k}"))
    assert len(tracker.snapshot().table.sensors.sensors) < 50


@ALL
def test_the_same_ids_at_whatever_time_the_scene_begins(make):
    rng = np.random.default_rng(3)
    frames = [f for f in seen(rng, CARS, np.arange(60) / 10, noise=0.4) if rng.random() < 0.4]
    told = []
    for start in (0.0, 1.7e9):
        tracks = run(make(), [frame(start + f.timestamp, f.detections.boxes.position[:, :2]) for f in frames])
        told.append([each.id.tolist() for each in tracks])
    assert told[0] == told[1]


def test_a_sensors_offset_is_a_time():
    with pytest.raises(InputError, match="time_offset: expected a number from"):
        Sensor(time_offset=1e300)
