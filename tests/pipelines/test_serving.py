"""Streams of frames, predictions, failures. The stream: messages, clock, reordering, and what a line is answered."""

import io
import json
import logging
import os
import re
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.checks import Checks
from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker, parse_address, serve_pipe
from pipelines.serving.messages import FrameMessage, encode, parse_message, predictions_message
from pipelines.serving.stream import Reordering
from saga_fg import Frame, InputError, Tracks
from saga_fg.model.edge_rules import Following
from saga_fg.numerics.geometry import yaw_of
from saga_fg.tracking import Tracker

SETTINGS = StreamSettings()


def stream(method: Any = "saga", horizons: Any = None, **settings: Any) -> StreamTracker[str]:
    config = load_config("file")
    return StreamTracker(lambda: config.new_tracker(method), StreamSettings(**settings), horizons=horizons)


def frame(timestamp: float, seq: int | None = None, sensor: str = "lidar", x: float | None = None) -> bytes:
    car = {"label": "car", "x": 8.0 * timestamp if x is None else x, "y": 2.0, "score": 0.9}
    message = {"timestamp": timestamp, "sensor": sensor, "detections": [car]}
    return encode(message if seq is None else {"seq": seq, **message})


def test_edge_rules_that_meet_no_class_are_told_once(caplog):
    for label, told in (("truck", 1), ("car", 0)):
        config = load_config("file")
        config = replace(config, tracker=replace(config.tracker, edges=(Following(classes=(label,)),)))
        service: StreamTracker[str] = StreamTracker(partial(config.new_tracker, "saga"), SETTINGS, Checks(config))
        caplog.clear()
        answers(service, *(frame(0.1 * k) for k in range(300)))
        assert [record.levelname for record in caplog.records] == ["WARNING"] * told


def test_what_looks_wrong_in_a_stream_is_told_once(caplog):
    config = load_config("file")
    for degrees in (True, False):
        service: StreamTracker[str] = StreamTracker(partial(config.new_tracker, "saga"), SETTINGS, Checks(config))
        caplog.clear()
        for k in range(250):
            yaw = (90.0 if k % 2 else 270.0) if degrees else 0.1
            car = {"label": "car", "x": 1.0 * k, "y": 2.0, "score": 90.0 if degrees else 0.9, "yaw": yaw}
            answers(service, encode({"timestamp": 0.1 * k, "detections": [car]}))
        told = [record.getMessage().partition(":")[0] for record in caplog.records]
        assert told == (["scores are not from 0 to 1", "headings look like degrees"] if degrees else [])


def answers(service: StreamTracker[str], *lines: bytes) -> list[dict[str, Any]]:
    return [answer for line in lines for _, answer in service.handle(line, "me")]


def test_a_frame_is_read_with_all_its_fields():
    line = encode(
        {
            "seq": 3, "timestamp": 1.5, "sensor": "radar", "coordinates": "ego",
            "ego": {"x": 10, "y": 20, "yaw": 0.5},
            "detections": [
                {"x": 1, "y": 2, "z": 0.5, "length": 4, "width": 2, "height": 1.5, "yaw": 0.1, "vx": 3, "vy": -1,
                 "range_rate": -2.5, "label": "truck", "score": 0.25},
                {"x": -1, "y": 0},
            ],
        }
    )  # fmt: skip
    message = parse_message(line, SETTINGS)
    assert isinstance(message, FrameMessage)
    assert message.seq == 3
    read = message.frame
    assert (read.timestamp, read.sensor, read.coordinates) == (1.5, "radar", "ego")
    assert read.world_T_ego is not None
    np.testing.assert_allclose(read.world_T_ego[:3, 3], [10, 20, 0])
    assert yaw_of(read.world_T_ego[:3, :3]) == pytest.approx(0.5)
    boxes = read.detections.boxes
    assert boxes.label.tolist() == ["truck", "object"]
    np.testing.assert_array_equal(boxes.position, [[1, 2, 0.5], [-1, 0, 0]])
    np.testing.assert_array_equal(boxes.size, [[4, 2, 1.5], [np.nan] * 3])
    np.testing.assert_array_equal(boxes.velocity, [[3, -1], [np.nan] * 2])
    np.testing.assert_array_equal(read.detections.score, [0.25, 1.0])
    np.testing.assert_array_equal(read.detections.range_rate, [-2.5, np.nan])


BAD_LINES = [
    (b"{", "broken JSON"),
    (b"\xff\xfe", "broken JSON"),
    (b"[" * 100_000, "broken JSON"),
    (b"[]", "expected an object"),
    (b'{"timestamp": NaN, "detections": []}', "JSON, which has no NaN"),
    (b'{"timestamp": 1e400, "detections": []}', "timestamp: expected a finite number"),
    (b'{"timestamp": true, "detections": []}', "timestamp: expected a finite number, got True"),
    (b'{"detections": []}', "timestamp: expected a finite number, it is left out"),
    (b'{"timestamp": 1700000000000000000, "detections": []}', "nanoseconds"),
    (b'{"timestamp": 1}', "detections: expected a list"),
    (b'{"timestamp": 1, "detections": [7]}', r"detections\[0\]: expected an object"),
    (b'{"timestamp": 1, "detections": [{"x": 1}]}', r"detections\[0\].y: expected a finite number, it is left out"),
    (b'{"timestamp": 1, "detections": [{"x": 1, "y": "2"}]}', r"detections\[0\].y: expected a finite number, got '2'"),
    (b'{"timestamp": 1, "detections": [{"x": 1, "y": 2, "lenght": 3}]}', "did you mean 'length'"),
    (b'{"timestamp": 1, "detections": [{"x": 1, "y": 2, "length": 0}]}', r"size\[0\]: expected positive"),
    (b'{"timestamp": 1, "detections": [{"x": 1, "y": 2, "label": ""}]}', "label: expected a name"),
    (b'{"timestamp": 1, "sensor": {}, "detections": []}', "sensor: expected a name"),
    (b'{"timestamp": 1, "coordinates": "ego", "detections": []}', "^ego: expected a pose"),
    (b'{"timestamp": 1, "coordinates": [], "detections": []}', "coordinates: expected one of"),
    (b'{"timestamp": 1, "ego": {"x": 1, "y": 2}, "detections": []}', "ego.yaw: expected a finite number"),
    (b'{"timestamp": 1, "seq": -1, "detections": []}', "seq: expected an integer"),
    (b'{"timestamp": 1, "timestmap": 1, "detections": []}', "did you mean 'timestamp'"),
    (b'{"type": "stop"}', "type: expected frame, status, subscribe, predict, reset, got 'stop'"),
    (b'{"type": "status", "x": 1}', "unknown field"),
]


def test_what_cannot_be_used_is_answered_counted_and_without_effect():
    service = stream()
    answers(service, frame(0.0))
    for line, message in BAD_LINES:
        (answer,) = answers(service, line)
        assert answer["type"] == "error"
        assert re.search(message, answer["message"]), (line, answer["message"])
    assert service.counts["refused"] == len(BAD_LINES)
    assert [t["id"] for t in answers(service, frame(0.1))[0]["tracks"]] == [1]


def test_limits_hold():
    with pytest.raises(InputError, match="at most 50 bytes"):
        parse_message(frame(0.0), StreamSettings(max_message=50))
    two = encode({"timestamp": 0, "detections": [{"x": 0, "y": 0}] * 2})
    with pytest.raises(InputError, match="detections: expected at most 1, got 2"):
        parse_message(two, StreamSettings(max_detections=1))
    crowd = encode({"timestamp": 0, "detections": [{"x": 0, "y": 0}] * 501})
    with pytest.raises(InputError, match="detections: expected at most 500, got 501"):
        parse_message(crowd, SETTINGS)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["type", "seq", "timestamp", "sensor", "coordinates", "ego", "detections", "x", "y", "yaw"]
            ),
            inner,
            max_size=6,
        )
    ),
    max_leaves=20,
)


@given(st.one_of(st.binary(max_size=60), JSON.map(lambda value: json.dumps(value).encode())))
def test_no_line_breaks_the_stream(line):
    service = stream()
    for answer in answers(service, line.replace(b"\n", b" ")):
        assert answer["type"] in ("error", "tracks", "status", "subscribe", "reset", "held")
        encode(answer)  # strict JSON


def test_tracks_are_answered_in_the_columns_of_track_files():
    service = stream()
    *_, last = answers(service, *(frame(k / 10, k) for k in range(20)))
    assert (last["seq"], last["sensor"], last["frame_timestamp"]) == (19, "lidar", 1.9)
    (track,) = last["tracks"]
    assert track["label"] == "car"
    assert track["x"] == pytest.approx(15.2, abs=0.1)
    assert track["vx"] == pytest.approx(8.0, abs=0.2)
    assert track["cov_xx"] > 0
    assert "length" not in track  # never measured
    assert track["coasting"] == 0


def test_numbered_frames_are_taken_in_once_and_a_reset_begins_anew():
    service = stream()
    first = answers(service, frame(0.0, 0), frame(0.1, 1), frame(0.1, 1), frame(0.0, 0), frame(0.1, 0, "camera"))
    assert [a["type"] for a in first] == ["tracks", "tracks", "repeat", "repeat", "tracks"]
    assert service.status()["last_seq"] == {"lidar": 1, "camera": 0}
    service = stream()
    before = answers(service, frame(50.0), frame(50.1))
    assert answers(service, b'{"type": "reset"}') == [{"type": "reset"}]
    after = answers(service, frame(3.0, x=0.0), frame(3.1, x=0.8))
    assert before[-1]["tracks"][0]["id"] == after[-1]["tracks"][0]["id"] == 1
    assert after[0]["timestamp"] == 3.0


def test_held_frames_go_in_in_order_of_time():
    service = stream(reorder=0.25)
    lines = [frame(t, k) for k, t in enumerate([0.0, 0.2, 0.1, 0.3, 0.5])]
    seen = [(a["type"], a["seq"]) for a in answers(service, *lines)]
    assert seen[:3] == [("held", 0), ("held", 1), ("held", 2)]
    tracked = [seq for kind, seq in seen if kind == "tracks"]
    assert tracked == [0, 2, 1]  # 0.5 s is the newest: those up to 0.25 s are due
    assert [a["seq"] for _, a in service.flush()] == [3, 4]
    assert service.counts["out_of_order"] == 1


@given(st.lists(st.floats(-20, 20), max_size=40), st.floats(0, 5), st.integers(1, 5))
def test_reordering_loses_nothing_and_holds_no_more_than_it_may(times, hold, most):
    buffer: Reordering[int] = Reordering(hold, most)
    out = []
    for k, t in enumerate(times):
        due = buffer.push(t, k)
        assert len(buffer) <= most
        assert [times[i] for i in due] == sorted(times[i] for i in due)
        out += due
    out += buffer.flush()
    assert sorted(out) == list(range(len(times)))


def test_a_frame_from_another_time_does_not_wait_and_moves_no_clock():
    buffer: Reordering[int] = Reordering(1.0, 5, max_jump=10.0)
    assert [buffer.push(t, k) for k, t in enumerate([5.0, 5.5, 100.0, 5.2, -50.0])] == [[], [], [0, 1, 2], [], [3, 4]]
    buffer.set_clock(100.0)
    assert [buffer.push(t, k) for k, t in enumerate([100.2, 5.0, 101.5])] == [[], [0, 1], []]


def test_a_pipe_is_served_to_its_end():
    read, write = os.pipe()
    os.write(write, frame(0.0) + b"nonsense\n" + b"x" * 2000 + b"\n" + frame(0.1).rstrip(b"\n"))
    os.close(write)
    sink = io.BytesIO()
    service: StreamTracker[None] = StreamTracker(
        lambda: load_config("file").new_tracker("kf"), StreamSettings(max_message=1000)
    )
    with os.fdopen(read, "rb") as source:
        serve_pipe(service, source, sink)
    kinds = [json.loads(line)["type"] for line in sink.getvalue().splitlines()]
    assert kinds == ["tracks", "error", "error", "tracks"]


ADDRESSES = [
    ("127.0.0.1:80", "127.0.0.1", 80, True),
    (":7447", "127.0.0.1", 7447, True),
    ("[::1]:1", "::1", 1, True),
    ("localhost:1", "localhost", 1, True),
    ("0.0.0.0:1", "0.0.0.0", 1, False),
    ("example.org:1", "example.org", 1, False),
]


def test_addresses():
    for text, host, port, local in ADDRESSES:
        address = parse_address(text)
        assert (address.host, address.port, address.is_local) == (host, port, local)
    assert parse_address("/tmp/x.sock").is_local
    for text in ("nowhere", "host:", "host:99999", "host:-1", "host:²", f"host:{'9' * 5000}"):
        with pytest.raises(InputError, match="expected HOST:PORT"):
            parse_address(text)


# Predictions of a stream: with every frame, and on request


def predict(horizons: Any, **more: Any) -> bytes:
    return encode({"type": "predict", "horizons": horizons} | more)


def test_a_request_is_answered_with_the_trackers_predictions():
    service = stream()
    answers(service, *(frame(0.1 * k) for k in range(10)))
    (answer,) = answers(service, predict([0.5, 2]))
    assert answer["type"] == "predictions"
    assert answer["timestamp"] == pytest.approx(0.9)
    assert answer["horizons"] == [0.5, 2.0]
    (car,) = answer["tracks"]
    assert (car["id"], car["label"]) == (1, "car")
    tracker = service._tracker
    assert isinstance(tracker, Tracker)
    expected = tracker.predict([0.5, 2])
    np.testing.assert_allclose([car["x"], car["y"]], expected.position[:, 0].T)
    np.testing.assert_allclose([car["vx"], car["vy"]], expected.velocity[:, 0].T)
    np.testing.assert_allclose(car["cov_xy"], expected.position_covariance[:, 0, 0, 1])
    assert car["cov_xx"][0] < car["cov_xx"][1]
    assert "yaw" not in car or len(car["yaw"]) == 2


def test_modes_come_where_they_are_asked_for():
    service = stream()
    answers(service, *(frame(0.1 * k) for k in range(10)))
    (plain,), (answer,) = answers(service, predict([0.5, 2])), answers(service, predict([0.5, 2], modes=True))
    (car,) = answer["tracks"]
    modes = car.pop("modes")
    assert answer == plain, "mean and covariance are the same"
    tracker = service._tracker
    assert isinstance(tracker, Tracker)
    expected = tracker.predict([0.5, 2], hypotheses=True).modes
    assert [mode["mode"] for mode in modes] == [mode.name for mode in expected]
    np.testing.assert_allclose(np.sum([mode["probability"] for mode in modes], axis=0), 1.0)
    for mode, one in zip(modes, expected, strict=True):
        np.testing.assert_allclose([mode["x"], mode["y"]], one.position[:, 0].T)
        np.testing.assert_allclose(mode["cov_xx"], one.position_covariance[:, 0, 0, 0])
    unknown = replace(expected[0], position=np.full_like(expected[0].position, np.nan))
    whole = tracker.predict([0.5, 2], hypotheses=True)
    (row,) = predictions_message(replace(whole, modes=(unknown, *expected[1:])), modes=True)["tracks"]
    assert [mode["mode"] for mode in row["modes"]] == [mode.name for mode in expected[1:]]
    (wrong,) = answers(service, predict([1], modes="all"))
    assert "modes: expected true or false, got 'all'" in wrong["message"]


def test_predictions_come_with_frames_or_requests_that_change_nothing():
    plain, asked = stream(), stream()
    expected = answers(plain, *(frame(0.1 * k) for k in range(6)))
    found = answers(asked, *(line for k in range(6) for line in (frame(0.1 * k), predict([3]))))
    assert found[::2] == expected
    horizons = np.array([1.0, 3.0])
    for answer in answers(stream(horizons=horizons), *(frame(0.1 * k) for k in range(3))):
        assert answer["type"] == "tracks"
        predicted = answer["predictions"]
        assert predicted["timestamp"] == answer["timestamp"]
        assert predicted["horizons"] == [1.0, 3.0]
        assert [each["id"] for each in predicted["tracks"]] == [each["id"] for each in answer["tracks"]]


BAD_HORIZONS = [
    (None, "horizons: expected a list of at most 20 s, it is left out"),
    ([0.1] * 21, "horizons: expected a list of at most 20 s"),
    (["1"], "horizons: expected a finite number, got '1'"),
    ([], "horizons: expected increasing seconds"),
    ([2, 1], "horizons: expected increasing seconds"),
    ([1, 11], "horizons: expected at most 10 s, got 11"),
]


def test_what_cannot_be_predicted_is_refused():
    service = stream()
    answers(service, frame(0.0))
    for horizons, why in BAD_HORIZONS:
        (answer,) = answers(service, predict(horizons))
        assert answer["type"] == "error"
        assert why in answer["message"]
    (early,) = answers(stream(), predict([1]))
    assert "expected a frame before" in early["message"]
    (never,) = answers(stream("centerpoint"), predict([1]))
    assert "expected --method saga or kf" in never["message"]


# A tracker that fails: the client is told, the stream goes on, and begins anew after several failures in a row


class Failing:
    """Fails as the label of the first detection says."""

    time_verdict = "accepted"
    max_jump = 10.0
    sensor_times: ClassVar[dict[str, Any]] = {}

    def step(self, frame: Frame) -> Tracks:
        label = str(frame.detections.boxes.label[0])
        if label == "bug":
            raise ZeroDivisionError("two\nlines")
        if label == "bad":
            raise InputError("label: expected a good one")
        return Tracks.empty(frame.timestamp)

    def tracks(self, timestamp: float) -> Tracks:
        return Tracks.empty(timestamp)


def failures_stream(made: list[Failing], **settings: Any) -> StreamTracker[str]:
    def new_tracker() -> Failing:
        made.append(Failing())
        return made[-1]

    return StreamTracker(cast(Any, new_tracker), StreamSettings(**settings))


def answer(service: StreamTracker[str], seq: int, label: str) -> dict[str, Any]:
    line = encode({"seq": seq, "timestamp": seq / 10, "detections": [{"label": label, "x": 0, "y": 0}]})
    ((_, told),) = service.handle(line, "me")
    return told


def test_an_internal_error_is_answered_logged_and_survived(caplog):
    service = failures_stream([])
    assert answer(service, 0, "car")["type"] == "tracks"
    with caplog.at_level(logging.ERROR):
        told = answer(service, 1, "bug")
    assert (told["type"], told["seq"]) == ("error", 1)
    assert told["message"] == "internal error: ZeroDivisionError: two lines"
    assert any(record.exc_info for record in caplog.records)
    status = service.status()
    assert (status["failures"], status["restarts"], status["refused"]) == (1, 0, 0)
    assert status["last_seq"] == {"sensor": 0}
    assert answer(service, 1, "car")["type"] == "tracks"


def test_failures_in_a_row_bring_a_fresh_tracker_and_others_do_not():
    made: list[Failing] = []
    service = failures_stream(made, max_failures=2)
    for seq, label in enumerate(["bug", "car", "bug", "bad", "bad"]):
        answer(service, seq, label)
    assert (len(made), service.status()["restarts"]) == (1, 0)
    answer(service, 9, "bug")
    assert (len(made), service.status()["restarts"]) == (2, 1)
    assert answer(service, 10, "car")["type"] == "tracks"


def test_an_error_outside_of_the_tracker_is_survived_too(monkeypatch):
    service = failures_stream([])
    monkeypatch.setattr("pipelines.serving.stream.resident_memory", lambda: 1 // 0)
    ((_, told),) = service.handle(b'{"type": "status"}', "me")
    assert told["message"].startswith("internal error: ZeroDivisionError")
    assert answer(service, 0, "car")["type"] == "tracks"
