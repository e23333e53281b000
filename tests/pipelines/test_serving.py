"""The stream: messages, clock, reordering, and what a line is answered."""

from __future__ import annotations

import io
import json
import os
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.checks import Checks
from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker, parse_address, serve_pipe
from pipelines.serving.frame_order import Reordering
from pipelines.serving.messages import FrameMessage, encode, parse_message
from saga_fg import InputError
from saga_fg.model.edge_rules import Following
from saga_fg.numerics.geometry import yaw_of

SETTINGS = StreamSettings()


def stream(**settings: Any) -> StreamTracker[str]:
    config = load_config("file")
    return StreamTracker(lambda: config.new_tracker("saga"), StreamSettings(**settings))


def frame(timestamp: float, seq: int | None = None, sensor: str = "lidar", x: float | None = None) -> bytes:
    car = {"label": "car", "x": 8.0 * timestamp if x is None else x, "y": 2.0, "score": 0.9}
    message = {"timestamp": timestamp, "sensor": sensor, "detections": [car]}
    return encode(message if seq is None else {"seq": seq, **message})


def test_edge_rules_that_meet_no_class_are_told_once(caplog: pytest.LogCaptureFixture):
    for label, told in (("truck", 1), ("car", 0)):
        config = load_config("file")
        config = replace(config, tracker=replace(config.tracker, edges=(Following(classes=(label,)),)))
        service: StreamTracker[str] = StreamTracker(partial(config.new_tracker, "saga"), SETTINGS, Checks(config))
        caplog.clear()
        answers(service, *(frame(0.1 * k) for k in range(300)))
        assert [record.levelname for record in caplog.records] == ["WARNING"] * told


def test_what_looks_wrong_in_a_stream_is_told_once(caplog: pytest.LogCaptureFixture):
    config = load_config("file")
    for degrees in (True, False):
        service: StreamTracker[str] = StreamTracker(partial(config.new_tracker, "saga"), SETTINGS, Checks(config))
        caplog.clear()
        for k in range(250):
            yaw = (90.0 if k % 2 else 270.0) if degrees else 0.1
            car = {"label": "car", "x": 1.0 * k, "y": 2.0, "score": 90.0 if degrees else 0.9, "yaw": yaw}
            answers(service, encode({"timestamp": 0.1 * k, "detections": [car]}))
        told = [record.getMessage().partition(":")[0] for record in caplog.records]
        assert told == (["headings look like degrees", "scores are not from 0 to 1"] if degrees else [])


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
    (
        b'{"timestamp": 1, "detections": [{"x": 1, "y": "2"}]}',
        r"detections\[0\].y: expected a finite number, got '2'",
    ),
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


def test_a_frame_with_a_number_is_taken_in_once():
    service = stream()
    first = answers(service, frame(0.0, 0), frame(0.1, 1), frame(0.1, 1), frame(0.0, 0), frame(0.1, 0, "camera"))
    assert [a["type"] for a in first] == ["tracks", "tracks", "repeat", "repeat", "tracks"]
    assert service.status()["last_seq"] == {"lidar": 1, "camera": 0}


def test_held_frames_go_in_in_order_of_time():
    service = stream(reorder=0.25)
    lines = [frame(t, k) for k, t in enumerate([0.0, 0.2, 0.1, 0.3, 0.5])]
    seen = [(a["type"], a["seq"]) for a in answers(service, *lines)]
    assert seen[:3] == [("held", 0), ("held", 1), ("held", 2)]
    tracked = [seq for kind, seq in seen if kind == "tracks"]
    assert tracked == [0, 2, 1]  # 0.5 s is the newest: those up to 0.25 s are due
    assert [a["seq"] for _, a in service.flush()] == [3, 4]
    assert service.counts["out_of_order"] == 1


def test_reset_begins_anew():
    service = stream()
    before = answers(service, frame(50.0), frame(50.1))
    assert answers(service, b'{"type": "reset"}') == [{"type": "reset"}]
    after = answers(service, frame(3.0, x=0.0), frame(3.1, x=0.8))
    assert before[-1]["tracks"][0]["id"] == after[-1]["tracks"][0]["id"] == 1
    assert after[0]["timestamp"] == 3.0


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
    for text in ("nowhere", "host:", "host:99999", "host:-1", "host:²"):
        with pytest.raises(InputError, match="expected HOST:PORT"):
            parse_address(text)
