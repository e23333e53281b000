"""Numbers of frames, and clocks."""

import json
import logging
from dataclasses import dataclass
from typing import Any, ClassVar, cast

from hypothesis import given
from hypothesis import strategies as st

from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.messages import encode
from pipelines.serving.stream import Numbering
from saga_fg import Frame, Tracks
from tests.pipelines.forked import run


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


def test_a_reset_brings_back_no_held_number_and_of_no_sensor_nothing():
    service = stream(reorder=1.0)
    assert kinds(service, frame(7, 0.0), frame(8, 0.1), reset("lidar")) == ["held"] * 2 + ["tracks"] * 2 + ["reset"]
    assert service.status()["last_seq"] == {}
    assert kinds(service, frame(0, 0.2)) == ["held"]
    service = stream()
    told = answers(service, frame(0, 0.0), *map(reset, (None, "", 3, "x" * 65)), frame(1, 0.1))
    assert all(answer["message"].startswith("sensor: expected a name") for answer in told[1:5])
    assert [track["id"] for track in told[5]["tracks"]] == [1]
    assert service.status()["last_seq"] == {"lidar": 1}


def test_the_reset_of_a_sensor_is_kept(tmp_path):
    def told(*lines: bytes) -> list[dict[str, Any]]:
        out, _ = run("serve", "--snapshot", tmp_path / "state", "--every", "3600", given=b"\n".join(lines))
        return [json.loads(line) for line in out.splitlines()]

    told(frame(5, 0.0), frame(6, 0.1))
    first, second = told(reset("lidar"), frame(0, 0.2))
    assert first == {"type": "reset", "sensor": "lidar", "durable": True}
    assert (second["type"], second["durable_seq"]) == ("tracks", -1)
    (third,) = told(frame(1, 0.3))
    assert (third["type"], third["durable_seq"]) == ("tracks", 0)


def test_one_sensor_more_and_the_number_of_the_one_silent_for_longest_is_forgotten(caplog):
    service = stream(max_sensors=2)
    with caplog.at_level(logging.WARNING):
        told = kinds(service, *(frame(0, 0.1 * k, name) for k, name in enumerate("ab")), frame(1, 0.2, "a"))
        told += kinds(service, *(frame(0, 0.3 + 0.01 * k, f"new {k}") for k in range(5)))
    assert told == ["tracks"] * 8
    assert list(service.status()["last_seq"]) == list(service.status()["taken"]) == ["new 3", "new 4"]
    assert caplog.messages == ["more than 2 numbered sensors: the number of 'b' is forgotten"]


def test_sensors_without_numbers_and_unconfirmed_numbers_fill_no_memory():
    service = stream(max_sensors=1)
    assert kinds(service, *(frame(None, k / 100, str(k)) for k in range(5)), frame(0, 0.1)) == ["tracks"] * 6
    assert service.status()["last_seq"] == {"lidar": 0}
    service = stream(max_sensors=3)
    service.handle(frame(None, 0.0), None)
    assert set(kinds(service, *(frame(0, 1e3 * (-2.0) ** (k + 1), str(k)) for k in range(10)))) == {"unconfirmed"}
    assert len(service.state()[0]["numbering"]["unconfirmed"]) == 3


# Numbers of frames: each frame is taken in once, and a kept state is good up to a number


def test_what_is_held_is_known_and_may_come_again_once_after_a_restart():
    numbers = Numbering()
    numbers.take("a", 0)
    numbers.hold("a", 1)
    numbers.hold("a", 3)
    numbers.take("a", 2)  # was younger, and went in before
    assert [numbers.known("a", n) for n in range(5)] == ["taken"] * 4 + [None]
    assert numbers.durable() == {"a": 0}
    before, after = Numbering(), Numbering()
    before.take("a", 0)
    before.hold("a", 1)
    before.take("a", 2)
    after.restore(before.state())
    assert [after.known("a", n) for n in range(4)] == ["taken", None, "taken", None]
    after.take("a", 1)
    assert (after.known("a", 1), after.durable(), after.taken["a"]) == ("taken", {"a": 2}, 3)


def test_a_client_that_goes_on_gives_up_what_it_has_not_sent_again():
    before, after = Numbering(), Numbering()
    before.hold("a", 1)
    before.take("a", 2)
    after.restore(before.state())
    assert after.durable() == {"a": 0}
    after.take("a", 3)
    assert (after.known("a", 1), after.durable()) == ("taken", {"a": 3})


@given(st.lists(st.tuples(st.integers(0, 12), st.booleans()), max_size=30), st.integers(0, 30))
def test_going_on_after_the_durable_number_takes_every_frame_in_once(frames, crash):
    """Frames 0, 1, 2... of which some are held for a while; the service is killed, and the rest is sent again."""
    taken: list[int] = []
    numbers, held = Numbering(), list[int]()

    def send(k: int, hold: bool) -> None:
        if numbers.known("a", k) is None:
            if hold:
                numbers.hold("a", k)
                held.append(k)
            else:
                numbers.take("a", k)
                taken.append(k)

    def settle() -> None:
        while held:
            numbers.release("a", held[0])
            numbers.take("a", held[0])
            taken.append(held.pop(0))

    for k, (turn, hold) in enumerate(frames[:crash]):
        send(k, hold)
        if turn == 0:
            settle()
    durable, state = numbers.durable().get("a", -1), numbers.state()
    numbers, held = Numbering(), []
    numbers.restore(state)
    for k in range(durable + 1, len(frames)):
        send(k, frames[k][1])
    settle()
    assert sorted(taken) == list(range(len(frames)))
    assert numbers.taken["a"] == len(frames)


# Verdicts of the tracker on times in a stream: the answers, the counts and the numbers of frames


class ScriptedTracker:
    """Has a verdict ready for every frame; keeps the times of those it took in."""

    max_jump = 10.0
    sensor_times: ClassVar[dict[str, Any]] = {}

    def __init__(self, *verdicts: str) -> None:
        self.verdicts = list(verdicts)
        self.time_verdict = "accepted"
        self.seen: list[float] = []

    def step(self, frame: Frame) -> Tracks:
        self.time_verdict = self.verdicts.pop(0) if self.verdicts else "accepted"
        self.seen.append(frame.timestamp)
        return self.tracks(max(self.seen))

    def tracks(self, timestamp: float) -> Tracks:
        return Tracks.empty(timestamp)


@dataclass
class Scripted:
    tracker: ScriptedTracker
    stream: StreamTracker[str]

    def kinds(self, *frames: tuple[float, int | None]) -> list[str]:
        return [answer["type"] for answer in self.answers(*frames)]

    def answers(self, *frames: tuple[float, int | None]) -> list[dict[str, Any]]:
        lines = [
            encode({"timestamp": t, "detections": []} | ({} if seq is None else {"seq": seq})) for t, seq in frames
        ]
        return [answer for line in lines for _, answer in self.stream.handle(line, "me")]


def scripted(*verdicts: str, **settings: Any) -> Scripted:
    tracker = ScriptedTracker(*verdicts)
    return Scripted(tracker, StreamTracker(lambda: cast(Any, tracker), StreamSettings(**settings)))


def test_late_frames_and_clocks_that_were_set_are_answered_and_counted():
    service = scripted("accepted", "late")
    assert service.kinds((5.0, 0), (1.0, 1), (1.0, 1)) == ["tracks", "late", "repeat"]
    status = service.stream.status()
    assert (status["frames"], status["late"], status["last_seq"], status["taken"]) == (
        *(1, 1),
        *({"sensor": 1}, {"sensor": 2}),
    )
    service = scripted("accepted", "unconfirmed", "set_ahead", "set_back")
    *_, ahead, back = service.answers((0.0, 0), (100.0, 1), (100.1, 2), (3.0, 3))
    assert (ahead["type"], ahead["clock"], back["clock"]) == ("tracks", "set_ahead", "set_back")
    assert service.stream.status()["jumps"] == 2


def test_unconfirmed_frames_are_left_out_and_never_confirm_themselves():
    service = scripted("accepted", "unconfirmed")
    kept, left_out = service.answers((0.0, 0), (1e6, 1))
    assert (kept["type"], left_out["type"], left_out["seq"]) == ("tracks", "unconfirmed", 1)
    assert "left out, unless the next one agrees" in left_out["message"]
    status = service.stream.status()
    assert (status["unconfirmed"], status["last_seq"]) == (1, {"sensor": 0})
    service = scripted("accepted", "unconfirmed")
    assert service.kinds((0.0, 0), (1e6, 1), (1e6, 1)) == ["tracks", "unconfirmed", "unconfirmed"]
    assert service.tracker.seen == [0.0, 1e6]
    assert service.kinds((0.1, 2), (1e6, 1)) == ["tracks", "unconfirmed"]


def test_reordering_follows_the_trackers_clock_over_glitches_and_gaps():
    service = scripted("accepted", "unconfirmed", reorder=0.5)
    # the glitch goes in behind what is held, and what follows is held as before
    assert service.kinds((0.0, 0), (100.0, 1), (0.1, 2)) == ["held", "tracks", "unconfirmed", "held"]
    service.tracker.verdicts = ["accepted", "set_ahead"]
    assert service.kinds((100.1, 3)) == ["tracks", "tracks"]
    assert service.kinds((100.2, 4)) == ["held"]
    service = scripted(reorder=0.5)
    assert service.kinds((0.0, 0), (15.0, 1)) == ["held", "tracks", "tracks"]
    assert service.kinds((15.1, 2), (15.2, 3)) == ["held", "held"]


def test_numbers_of_refused_frames_stay_open():
    service = scripted()
    broken = encode({"seq": 3, "timestamp": 1.0, "detections": [{"x": 1}]})
    assert service.stream.handle(broken, "me")[0][1]["type"] == "error"
    assert service.kinds((1.0, 3)) == ["tracks"]
