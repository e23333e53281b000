"""The benchmark of the service among hostile clients, on a small scale."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from benchmarks.service.good_client import GoodClient
from benchmarks.service.hostile_messages import EPOCH, KINDS, MOST, SENSORS, hostile_line
from benchmarks.service.hostile_service import bench_hostile_service, shortcomings
from pipelines.config import load_config
from pipelines.serving import StreamTracker
from pipelines.serving.messages import encode

FINE = {"valid": 10, "tracked": 10, "lost": 0, "doubled": 0, "longest_stall": 0.3, "machine_stall": 0.1}
FINE |= {"memory_growth": 1.01, "full_disk_told": True, "second_refused": True}


def test_no_good_frame_is_lost_or_doubled_by_kills_and_floods():
    found = bench_hostile_service(messages=400, objects=3, pace=20.0, seed=0)
    assert [found[name] for name in ("valid", "answered", "lost", "doubled", "hostile")] == [80, 80, 0, 0, 320]
    assert 0 < found["tracked"] <= 80 - found["late"] - found["unconfirmed"]
    assert found["full_disk_told"]
    assert found["second_refused"]
    assert all(found[name] > 0 for name in ("refused", "sent_again", "first_answer"))


def test_what_falls_short_is_named():
    assert shortcomings(FINE) == []
    bad = FINE | {"tracked": 9, "lost": 1, "doubled": 2, "longest_stall": 0.5, "memory_growth": 1.06}
    bad |= {"full_disk_told": False, "second_refused": False}
    assert [text.split(",")[0] for text in shortcomings(bad)] == [
        *("1 frames lost", "2 frames doubled", "9 of 10 frames tracked"),
        *("a stall of 0.400 s over that of the machine", "a full disk was not told in the status"),
        *("another service has taken the same snapshot", "memory grew to 1.060 of the start"),
    ]


def test_what_is_lost_does_not_make_up_for_what_is_doubled():
    for taken, answers, counted, expected in [
        ([0, 1, 2], ["tracks", "late", "tracks"], 3, (0, 0)),
        ([0, 2], ["tracks", "unconfirmed", "tracks"], 2, (0, 0)),
        ([0, 2], ["tracks", "repeat", "tracks"], 3, (0, 0)),
        ([0, 0, 1, 2], ["tracks"] * 3, 4, (0, 1)),
        ([0, 0, 1, 2], ["tracks"] * 3, 3, (1, 1)),  # one was taken in twice, and another is not counted
        ([0, 0, 1], ["tracks"] * 2, 3, (1, 1)),
        ([0, 1, 2], ["tracks"] * 3, 4, (0, 1)),
    ]:
        client = GoodClient.__new__(GoodClient)
        client.frames, client.taken, client.answers = 3, Counter(taken), dict(enumerate(answers))
        assert client.lost_and_doubled(counted) == expected, (taken, answers, counted)


def test_no_message_in_the_name_of_a_good_sensor_takes_its_numbers():
    config, rng = load_config("file"), np.random.default_rng(0)
    config = replace(config, tracker=replace(config.tracker, min_hits=1))  # so that one message is answered by tracks
    service = StreamTracker[None](lambda: config.new_tracker("kf"))
    for sensor in SENSORS:
        service.handle(encode({"timestamp": EPOCH, "sensor": sensor, "seq": 0, "detections": []}), None)
    numbered = heavy = 0
    for kind in KINDS:
        service.handle(b'{"type": "reset"}', None)
        for line in b"\n".join(kind(rng, EPOCH) for _ in range(5)).split(b"\n"):
            ((_, answer),) = service.handle(line, None) or [(None, {"type": ""})]
            heavy += answer["type"] == "tracks" and len(answer["tracks"]) > MOST / 2
            numbered += "seq: expected at most" in answer.get("message", "")
    assert numbered == 5
    assert {sensor: service.status()["last_seq"][sensor] for sensor in SENSORS} == dict.fromkeys(SENSORS, 0)
    assert heavy > 0


def test_clocks_of_others_leave_out_hardly_any_frame():
    """Three seconds of hostile messages, four of them between two good frames; nobody resets."""
    config, rng, answers = load_config("file"), np.random.default_rng([0, 7]), Counter[str]()
    service = StreamTracker[None](lambda: config.new_tracker("kf"))
    for seq in range(150):
        for number, sensor in enumerate(SENSORS):
            elapsed = (seq + number / 2) / 50
            for _ in range(4):
                for line in hostile_line(rng, EPOCH + elapsed).split(b"\n"):
                    if b"reset" not in line and len(line) < 2**12:
                        service.handle(line, None)
            frame = {"seq": seq, "timestamp": EPOCH + elapsed, "sensor": sensor, "detections": []}
            ((_, answer),) = service.handle(encode(frame), None)
            answers[answer["type"]] += seq > 10
    assert answers["tracks"] >= 0.97 * (answers.total())
