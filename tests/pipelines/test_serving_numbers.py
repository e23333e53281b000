"""Numbers of frames that somebody else, or a client that was restarted, has sent: no sensor is shut out by them."""

from __future__ import annotations

import json
import logging
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.messages import encode
from tests.pipelines.running_service import COMMAND


def stream(**settings: Any) -> StreamTracker[None]:
    return StreamTracker(lambda: load_config("file").new_tracker("kf"), StreamSettings(**settings))


def frame(seq: int | None, timestamp: float, sensor: str = "lidar") -> bytes:
    number = {} if seq is None else {"seq": seq}
    return encode(number | {"timestamp": timestamp, "sensor": sensor, "detections": [{"x": 1.0, "y": 2.0}]})


def reset(sensor: Any) -> bytes:
    return encode({"type": "reset", "sensor": sensor})


def answers(service: StreamTracker[None], *lines: bytes) -> list[dict[str, Any]]:
    return [answer for line in lines for _, answer in service.handle(line, None)]


def kinds(service: StreamTracker[None], *lines: bytes) -> list[str]:
    return [answer["type"] for answer in answers(service, *lines)]


def test_a_number_far_beyond_the_last_one_is_refused_and_changes_nothing():
    service = stream()
    assert kinds(service, frame(5_000_000, 0.0)) == ["tracks"], "the service may have started after the client"
    told = answers(service, frame(2**63 - 1, 0.1), frame(6_000_001, 0.2), frame(6_000_000, 0.3))
    assert [answer["type"] for answer in told] == ["error", "error", "tracks"]
    assert told[1]["message"] == "seq: expected at most 6000000 after 5000000, the last one of 'lidar', got 6000001"
    assert kinds(stream(max_seq_jump=3), *(frame(seq, seq / 10) for seq in (3, 7, 6))) == ["tracks", "error", "tracks"]


def test_a_client_that_counts_from_0_again_sees_why_and_resets_its_number():
    service = stream()
    assert kinds(service, *(frame(k, k / 10) for k in range(5)), frame(0, 0.4, "radar")) == ["tracks"] * 6
    assert answers(service, frame(0, 0.5)) == [
        {"type": "repeat", "last_seq": 4, "seq": 0, "sensor": "lidar", "frame_timestamp": 0.5}
    ]
    assert answers(service, reset("lidar")) == [{"type": "reset", "sensor": "lidar"}]
    assert service.status()["last_seq"] == {"radar": 0}
    again = answers(service, frame(0, 0.5), frame(0, 0.6, "radar"))
    assert [answer["type"] for answer in again] == ["tracks", "repeat"]
    assert [track["id"] for track in again[0]["tracks"]] == [1]  # tracks stay


def test_what_is_held_does_not_bring_the_number_back():
    service = stream(reorder=1.0)
    assert kinds(service, frame(7, 0.0), frame(8, 0.1), reset("lidar")) == ["held"] * 2 + ["tracks"] * 2 + ["reset"]
    assert service.status()["last_seq"] == {}
    assert kinds(service, frame(0, 0.2)) == ["held"]


def test_a_reset_of_no_sensor_resets_nothing():
    service = stream()
    told = answers(service, frame(0, 0.0), *map(reset, (None, "", 3, "x" * 65)), frame(1, 0.1))
    assert all(answer["message"].startswith("sensor: expected a name") for answer in told[1:5])
    assert [track["id"] for track in told[5]["tracks"]] == [1]
    assert service.status()["last_seq"] == {"lidar": 1}


def test_the_reset_of_a_sensor_is_kept(tmp_path: Path):
    command = [*COMMAND, "serve", "--snapshot", str(tmp_path / "state"), "--every", "3600"]

    def told(*lines: bytes) -> list[dict[str, Any]]:
        done = subprocess.run(command, input=b"\n".join(lines), capture_output=True, check=True)
        return [json.loads(line) for line in done.stdout.splitlines()]

    told(frame(5, 0.0), frame(6, 0.1))
    first, second = told(reset("lidar"), frame(0, 0.2))
    assert first == {"type": "reset", "sensor": "lidar", "durable": True}
    assert (second["type"], second["durable_seq"]) == ("tracks", -1)
    (third,) = told(frame(1, 0.3))
    assert (third["type"], third["durable_seq"]) == ("tracks", 0)


def test_one_sensor_more_and_the_number_of_the_one_silent_for_longest_is_forgotten(caplog: pytest.LogCaptureFixture):
    service = stream(max_sensors=2)
    with caplog.at_level(logging.WARNING):
        told = kinds(service, *(frame(0, 0.1 * k, name) for k, name in enumerate("ab")), frame(1, 0.2, "a"))
        told += kinds(service, *(frame(0, 0.3 + 0.01 * k, f"new {k}") for k in range(5)))
    assert told == ["tracks"] * 8
    assert list(service.status()["last_seq"]) == list(service.status()["taken"]) == ["new 3", "new 4"]
    assert caplog.messages == ["more than 2 numbered sensors: the number of 'b' is forgotten"]


def test_names_without_numbers_are_not_counted():
    service = stream(max_sensors=1)
    assert kinds(service, *(frame(None, k / 100, str(k)) for k in range(5)), frame(0, 0.1)) == ["tracks"] * 6
    assert service.status()["last_seq"] == {"lidar": 0}


def test_unconfirmed_numbers_of_ever_new_sensors_are_not_all_kept():
    service = stream(max_sensors=3)
    service.handle(frame(None, 0.0), None)
    assert set(kinds(service, *(frame(0, 1e3 * (-2.0) ** (k + 1), str(k)) for k in range(10)))) == {"unconfirmed"}
    assert len(service.state()[0]["numbering"]["unconfirmed"]) == 3
