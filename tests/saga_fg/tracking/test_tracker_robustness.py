"""Nothing that a sensor sends stops a tracker: steps are transactions, states stay in bounds, numbers are judged."""

import logging
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings

from saga_fg import Boxes, Detection, Detections, Frame, GreedyTracker, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.estimators import JointKalmanFilter
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from saga_fg.tracking import tracker as tracker_module
from saga_fg.tracking.clock import RESET_AFTER
from saga_fg.types.boxes import MAX_POSITION
from tests.saga_fg.traffic_frames import frame, run, seen, straight

ESTIMATORS = ("kalman", "isam2", "fixed-lag")
CARS = straight([(0.0, 0.0), (12.0, 0.0), (24.0, 0.0)], [(8.0, 0.0), (8.5, 0.0), (9.0, 0.0)])
POSE = np.eye(4)
FAR = np.array([[1e5, -2e5]])


def traffic(count=10):
    """Frames at 10 Hz."""
    return seen(np.random.default_rng(0), CARS, np.arange(count) / 10)


# whatever comes: the whole range of numbers, in every field

ANY = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-50.0, 50.0))
CORRUPTIONS = ("timestamp", "position", "velocity", "range_rate", "score", "size", "yaw", "ego")


@st.composite
def corrupted(draw):
    """A field of a frame, and what is written there."""
    return draw(st.sampled_from(CORRUPTIONS)), draw(st.lists(ANY, min_size=3, max_size=3))


def written(timestamp, places, corruption):
    """A radar's frame; raises `InputError` where validation refuses what was written."""
    n = len(places)
    values = {
        "timestamp": timestamp,
        "position": np.c_[places, np.zeros(n)],
        "velocity": np.full((n, 2), np.nan),
        "range_rate": np.full(n, np.nan),
        "score": np.full(n, 0.9),
        "size": np.full((n, 3), 2.0),
        "yaw": np.zeros(n),
        "ego": POSE,
    }
    if corruption is not None:
        name, numbers = corruption
        if name == "timestamp":
            values[name] = numbers[0] + timestamp if abs(numbers[0]) < 50.0 else numbers[0]
        elif name == "ego":
            values[name] = POSE.copy()
            values[name][:3, 3] = numbers
        else:
            shape = values[name].shape
            values[name] = np.broadcast_to(numbers[: shape[1]] if len(shape) == 2 else numbers[0], shape)
    boxes = Boxes.of(["car"] * n, values["position"], values["size"], values["yaw"], values["velocity"])
    return Frame(values["timestamp"], "radar", Detections(boxes, values["score"], values["range_rate"]), values["ego"])


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "centerpoint"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    corruptions=st.lists(st.one_of(st.none(), corrupted()), max_size=14),
    epoch=st.sampled_from([0.0, 1.7e9]),
    max_step=st.sampled_from([np.inf, 0.05]),
)
@example(corruptions=[("timestamp", [0.75, 0.0, 0.0])], epoch=0.0, max_step=np.inf)
@example(corruptions=[("timestamp", [0.5, 0.0, 0.0]), ("range_rate", [4.0, 0.0, 0.0])], epoch=0.0, max_step=np.inf)
def test_a_valid_frame_is_tracked_after_whatever_came_before(estimator, corruptions, epoch, max_step):
    logging.disable(logging.WARNING)
    if estimator == "centerpoint":
        tracker = GreedyTracker()
    else:
        tracker = Tracker(TrackerSettings(estimator=estimator, max_step=max_step, lag=0.5))
    try:
        for k, corruption in enumerate(corruptions):
            try:
                tracker.step(written(epoch + 0.1 * k, CARS(0.1 * k), corruption))
            except InputError:
                continue
        # late frames are left out until their clock is believed, and a track is reported from its second hit on
        times = epoch + 0.1 * (len(corruptions) + np.arange(RESET_AFTER + 1))
        tracks = [tracker.step(frame(t, FAR, sensor="radar")) for t in times.tolist()][-1]
    finally:
        logging.disable(logging.NOTSET)
    apart = np.hypot(*(tracks.boxes.position[:, :2] - FAR).T)
    assert (apart < 1.0).sum() == 1
    assert 0.0 <= tracks.timestamp - times[-1] <= 0.5, "the newest time, within the delay that frames may have"


# a step is a transaction


@pytest.mark.parametrize(
    ("estimator", "stage", "error"),
    [
        ("kalman", "associate", ArithmeticError),
        ("isam2", "update_tracks", ArithmeticError),
        ("fixed-lag", "update_existence", ArithmeticError),
        ("isam2", "initiate_tracks", ArithmeticError),
        ("fixed-lag", "delete_tracks", KeyboardInterrupt),
    ],
)
def test_what_raises_in_a_step_leaves_the_tracker_as_it_was(monkeypatch, estimator, stage, error):
    silent, failing = (Tracker(TrackerSettings(estimator=estimator)) for _ in range(2))
    frames = traffic(12)
    for tracker in (silent, failing):
        run(tracker, frames[:10])
    original = getattr(tracker_module, stage)

    def breaking(*arguments):
        original(*arguments)
        raise error("broken")

    with monkeypatch.context() as patched:
        patched.setattr(tracker_module, stage, breaking)
        with pytest.raises(error, match="broken"):
            failing.step(frames[10])
    for a, b in zip(run(silent, frames[10:]), run(failing, frames[10:]), strict=True):
        assert b.id.tolist() == a.id.tolist()
        assert b.boxes.position == pytest.approx(a.boxes.position, abs=1e-9)
        assert b.score == pytest.approx(a.score)


def test_tracks_that_cannot_go_on_are_given_up_at_the_second_frame(monkeypatch, caplog):
    def singular(self, transition):
        if len(self.nodes):
            raise np.linalg.LinAlgError("singular")

    tracker = Tracker()
    run(tracker, traffic())
    monkeypatch.setattr(JointKalmanFilter, "predict", singular)
    with pytest.raises(np.linalg.LinAlgError):
        tracker.step(frame(1.0, CARS(1.0)))
    assert tracker.tracks(0.9).id.tolist() == [1, 2, 3]
    assert tracker.step(frame(1.1, CARS(1.1))).id.tolist() == [4, 5, 6]
    assert "tracks [1, 2, 3] are deleted, they can't go on: singular" in caplog.text


# states stay in bounds


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_tracks_that_leave_all_bounds_are_deleted_by_name_and_the_others_go_on(estimator, caplog):
    tracker = Tracker(TrackerSettings(edges=(), estimator=estimator))
    near = [(0.0, 0.0), (MAX_POSITION - 1.0, 50.0)]
    tracker.step(frame(0.0, near, velocity=[(0.0, 0.0), (140.0, 0.0)]))
    tracks = tracker.step(frame(0.1, near[:1]))
    assert tracks.id.tolist() == [1]
    assert "deleted, since their states are out of bounds: tracks [2]" in caplog.text
    assert tracker.step(frame(0.2, near[:1])).id.tolist() == [1]


def test_a_state_that_is_not_finite_is_deleted_and_the_others_go_on(monkeypatch, caplog):
    update = JointKalmanFilter.update

    def poisoning(self, measurements):
        likelihood = update(self, measurements)
        mean = self._state.mean.copy()
        mean[:4] = np.nan
        self._state = replace(self._state, mean=mean)
        return likelihood

    tracker = Tracker(TrackerSettings(edges=()))
    run(tracker, traffic())
    with monkeypatch.context() as patched:
        patched.setattr(JointKalmanFilter, "update", poisoning)
        assert tracker.step(frame(1.0, CARS(1.0))).id.tolist() == [2, 3]
    assert "out of bounds: tracks [1]" in caplog.text
    assert tracker.step(frame(1.1, CARS(1.1))).id.tolist() == [2, 3, 4]


@pytest.mark.parametrize("timestamp", [1e12, 1e300])
def test_looking_ahead_for_ever(timestamp):
    tracker = Tracker(TrackerSettings({"default": ClassSettings(max_deviation=np.inf)}))
    run(tracker, traffic())
    assert len(tracker.tracks(timestamp)) == 0
    assert tracker.step(frame(1.0, CARS(1.0))).id.tolist() == [1, 2, 3]


@pytest.mark.parametrize("max_step", [1e-9, 5e-324])
def test_the_steps_of_an_interval_are_limited(max_step, caplog):
    tracker = Tracker(TrackerSettings(max_step=max_step))
    run(tracker, traffic(4))
    assert "0.1 s are predicted in 100 steps, max_step asks for" in caplog.text
    assert tracker.tracks(0.3).id.tolist() == [1, 2, 3]


# range rates and velocities

RADAR = {"radar": Sensor(noise={"default": NoiseModel(range_rate=0.1)})}


def with_rate(timestamp, rate, velocity=None):
    plain = frame(timestamp, [(30.0 + timestamp * 10.0, 0.0)], "radar", velocity=velocity)
    return Frame(timestamp, "radar", replace(plain.detections, range_rate=np.array([rate])), POSE)


@pytest.mark.parametrize(
    ("estimator", "rate"), [("kalman", 60.0), ("isam2", -140.0), ("fixed-lag", 300.0), ("kalman", 9e5)]
)
def test_a_wrong_range_rate_changes_nothing(estimator, rate):
    """60 and -140 m/s could be, and are gated; more than 150 m/s is no speed on a road."""
    right, wrong = (Tracker(TrackerSettings(estimator=estimator), RADAR) for _ in range(2))
    for k in range(20):
        good, bad = with_rate(0.1 * k, 10.0), with_rate(0.1 * k, rate if k in (10, 11) else 10.0)
        without = with_rate(0.1 * k, np.nan if k in (10, 11) else 10.0)
        assert len(good) == 1
        expected, got = right.step(without), wrong.step(bad)
    assert got.boxes.velocity == pytest.approx(expected.boxes.velocity, abs=1e-9)
    assert got.boxes.velocity[0] == pytest.approx([10.0, 0.0], abs=0.5)


# what is no frame, and copies


def test_what_are_no_frames_or_detections_is_refused(subtests):
    for make in [Tracker, GreedyTracker]:
        for nothing in [None, [], [Detection("car", (0, 0, 0))], np.zeros((3, 2))]:
            with (
                subtests.test(make=make, nothing=nothing),
                pytest.raises(InputError, match=f"frame: expected Frame, got {type(nothing).__name__}"),
            ):
                make().step(nothing)
    assert len(Detections.of(Detection("car", (k, 0, 0)) for k in range(3))) == 3
    for rows in [np.zeros((3, 2)), [(0, 0, 0)], [None], 7, None]:
        with subtests.test(rows=rows), pytest.raises(InputError, match="detections: expected a list of Detection"):
            Detections.of(rows)


def test_settings_and_sensors_of_another_type_are_named(subtests):
    for make in [Tracker, GreedyTracker]:
        for arguments, message in [
            ({"settings": {"min_hits": 2}}, "settings: expected {}, got dict"),
            ({"sensors": {"lidar": 0.3}}, "sensors.lidar: expected Sensor, got float"),
            ({"sensors": ()}, "sensors: expected Mapping, got tuple"),
        ]:
            with subtests.test(message):
                wanted = {Tracker: "TrackerSettings", GreedyTracker: "GreedySettings"}[make]
                with pytest.raises(InputError, match=message.format(wanted)):
                    make(**arguments)
                with pytest.raises(InputError, match=r"snapshot: expected \w+Snapshot, got str"):
                    make().restore("state.json")
