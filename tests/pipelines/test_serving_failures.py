"""A tracker that fails: the client is told, the stream goes on, and begins anew after several failures in a row."""

from __future__ import annotations

import logging
from typing import Any, ClassVar, cast

import pytest

from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.messages import encode
from saga_fg import Frame, InputError, Tracks


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


def stream(made: list[Failing], **settings: Any) -> StreamTracker[str]:
    def new_tracker() -> Failing:
        made.append(Failing())
        return made[-1]

    return StreamTracker(cast(Any, new_tracker), StreamSettings(**settings))


def answer(service: StreamTracker[str], seq: int, label: str) -> dict[str, Any]:
    line = encode({"seq": seq, "timestamp": seq / 10, "detections": [{"label": label, "x": 0, "y": 0}]})
    ((_, told),) = service.handle(line, "me")
    return told


def test_an_internal_error_is_answered_logged_and_survived(caplog: pytest.LogCaptureFixture):
    service = stream([])
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
    service = stream(made, max_failures=2)
    for seq, label in enumerate(["bug", "car", "bug", "bad", "bad"]):
        answer(service, seq, label)
    assert (len(made), service.status()["restarts"]) == (1, 0)
    answer(service, 9, "bug")
    assert (len(made), service.status()["restarts"]) == (2, 1)
    assert answer(service, 10, "car")["type"] == "tracks"


def test_an_error_outside_of_the_tracker_is_survived_too(monkeypatch: pytest.MonkeyPatch):
    service = stream([])
    monkeypatch.setattr("pipelines.serving.stream.resident_memory", lambda: 1 // 0)
    ((_, told),) = service.handle(b'{"type": "status"}', "me")
    assert told["message"].startswith("internal error: ZeroDivisionError")
    assert answer(service, 0, "car")["type"] == "tracks"
