"""Verdicts of the tracker on times in a stream: the answers, the counts and the numbers of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, cast

from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.messages import encode
from saga_fg import Frame, Tracks


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


def test_a_late_frame_is_answered_as_late_and_done_with():
    service = scripted("accepted", "late")
    assert service.kinds((5.0, 0), (1.0, 1), (1.0, 1)) == ["tracks", "late", "repeat"]
    status = service.stream.status()
    assert (status["frames"], status["late"], status["last_seq"], status["taken"]) == (
        *(1, 1),
        *({"sensor": 1}, {"sensor": 2}),
    )


def test_an_unconfirmed_frame_is_left_out_and_its_number_stays_open():
    service = scripted("accepted", "unconfirmed")
    kept, left_out = service.answers((0.0, 0), (1e6, 1))
    assert (kept["type"], left_out["type"], left_out["seq"]) == ("tracks", "unconfirmed", 1)
    assert "left out, unless the next one agrees" in left_out["message"]
    status = service.stream.status()
    assert (status["unconfirmed"], status["last_seq"]) == (1, {"sensor": 0})


def test_an_unconfirmed_frame_that_is_sent_again_does_not_confirm_itself():
    service = scripted("accepted", "unconfirmed")
    assert service.kinds((0.0, 0), (1e6, 1), (1e6, 1)) == ["tracks", "unconfirmed", "unconfirmed"]
    assert service.tracker.seen == [0.0, 1e6]
    assert service.kinds((0.1, 2), (1e6, 1)) == ["tracks", "unconfirmed"]


def test_a_clock_that_was_set_is_told_and_counted():
    service = scripted("accepted", "unconfirmed", "set_ahead", "set_back")
    *_, ahead, back = service.answers((0.0, 0), (100.0, 1), (100.1, 2), (3.0, 3))
    assert (ahead["type"], ahead["clock"], back["clock"]) == ("tracks", "set_ahead", "set_back")
    assert service.stream.status()["jumps"] == 2


def test_reordering_follows_the_trackers_clock_and_not_a_glitch():
    service = scripted("accepted", "unconfirmed", reorder=0.5)
    # the glitch goes in behind what is held, and what follows is held as before
    assert service.kinds((0.0, 0), (100.0, 1), (0.1, 2)) == ["held", "tracks", "unconfirmed", "held"]
    service.tracker.verdicts = ["accepted", "set_ahead"]
    assert service.kinds((100.1, 3)) == ["tracks", "tracks"]
    assert service.kinds((100.2, 4)) == ["held"]


def test_numbers_of_refused_frames_stay_open():
    service = scripted()
    broken = encode({"seq": 3, "timestamp": 1.0, "detections": [{"x": 1}]})
    assert service.stream.handle(broken, "me")[0][1]["type"] == "error"
    assert service.kinds((1.0, 3)) == ["tracks"]


def test_reordering_goes_on_after_a_gap_that_the_tracker_accepts():
    service = scripted(reorder=0.5)
    assert service.kinds((0.0, 0), (15.0, 1)) == ["held", "tracks", "tracks"]
    assert service.kinds((15.1, 2), (15.2, 3)) == ["held", "held"]
