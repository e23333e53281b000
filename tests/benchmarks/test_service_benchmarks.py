"""Benchmarks of the service and of speed."""

import sys
import tracemalloc
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks import kills
from benchmarks.endurance import EDGES, LONG, NONE, endurance
from benchmarks.kills import Killed, _damage, _kill, _marked
from benchmarks.service import clocks
from benchmarks.service.clocks import ClockFault, fault_rows, offset_figures, offset_shortcomings
from benchmarks.service.hostile_service import GoodClient, bench_hostile_service, shortcomings
from benchmarks.speed import METHODS, Ties, speed_config, speed_frames
from pipelines.config import Method
from saga_fg.errors import SagaError


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return [{"table": title, **row} for title, row in endurance(100, "kalman,fixed-lag", 30, 10, 0)]


def test_tracks_begin_and_end_and_nothing_is_lost_whatever_the_traffic(rows):
    long = [row for row in rows if row["table"] == LONG]
    assert [(row["estimator"], row["frames"]) for row in long] == [("kalman", 100), ("fixed-lag", 40)]
    assert long[0]["tracks"] > 3 * long[0]["reported"] > 9
    assert all(row["files, last - second"] == 0 for row in long)
    for row in (row for row in rows if row["table"] == NONE):
        assert row["apart"] < 0.01
        assert row["reported, old / fresh"] == pytest.approx(1.0, abs=0.02)
    found = {(row["case"], row["size"]): row["reported"] for row in rows if row["table"] == EDGES}
    assert (found["detections in a frame", 3], found["detections in a frame", 30]) == (3, 30)
    assert found["sensors", 1] == found["sensors", 10] > 3
    assert found["position, m", 0.0] == found["position, m", 9e8] > 3


def test_what_cannot_be_run_is_refused(refused):
    assert "--estimators: unknown name 'kalmann'; did you mean 'kalman'?" in refused(
        "endurance --estimators", "kalmann"
    )
    assert "--sizes: expected whole numbers >= 1" in refused("speed --sizes", "")


# The benchmark of kills finds files that are not whole, and kills what a command has started

FIRST = {"labels/a.csv": b"1,2\n", "labels/b.json": b'{"time": 1}', "tracks.json": b"[1, 2]"}
FIXED = {name: FIRST[name] for name in ("labels/a.csv", "tracks.json")}
STEP, PARTS = Killed((), "labels"), Killed((), "labels", in_parts=True)


def test_what_is_not_whole_is_damage(subtests):
    for left, command, wrong in [
        ({}, STEP, ()),
        (FIRST, STEP, ()),
        ({**FIRST, "labels/b.json": b'{"time": 2}'}, STEP, ()),
        ({"labels/a.csv": b"1,2\n"}, PARTS, ()),
        ({"labels/a.csv": b"1,2\n"}, STEP, ("labels/b.json",)),
        ({"labels/a.csv": b"1,"}, PARTS, ("labels/a.csv",)),
        ({**FIRST, "labels/b.json": b'{"tim'}, STEP, ("labels/b.json",)),
        ({"tracks.json": b"[1,"}, STEP, ("tracks.json",)),
        ({"other.json": b"[]"}, STEP, ("other.json",)),
        ({"labels/manifest/s.json": b"{"}, PARTS, ("labels/manifest/s.json",)),
        ({"labels/manifest/s.json": b"{}"}, PARTS, ()),
    ]:
        with subtests.test(left=str(left)):
            assert tuple(text.partition(":")[0] for text in _damage(left, FIXED, FIRST, command)) == wrong


def test_all_that_a_command_has_started_is_killed(monkeypatch, tmp_path):
    sleep = "import time; time.sleep(60)"
    start = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {sleep!r}], start_new_session=True)"
    marks = []
    monkeypatch.setattr(kills, "PROGRAM", (sys.executable, "-c"))
    monkeypatch.setattr(kills, "_marked", lambda mark: marks.append(mark) or _marked(mark))
    assert not _kill(tmp_path, (start,), 1.0)
    assert not _marked(marks[0])
    assert _kill(tmp_path, ("pass",), 30.0)


def test_a_command_that_writes_into_its_place_is_found(monkeypatch, tmp_path):
    slow = (
        "import pathlib, time\n"
        "with pathlib.Path('out.txt').open('w') as file:\n"
        "    for k in range(20):\n"
        "        print(k, file=file, flush=True)\n"
        "        time.sleep(0.02)\n"
    )
    monkeypatch.setattr(kills, "PROGRAM", (sys.executable, "-c"))
    found = kills._killed(Killed((slow,), "out.txt"), tmp_path, 6, np.random.default_rng(0))
    assert found["damaged"] > 0
    assert found["resumed"] == found["resumed and equal"] == 2


# The benchmark of the service among hostile clients, on a small scale

FINE = {"valid": 10, "tracked": 10, "lost": 0, "doubled": 0, "longest_stall": 0.3, "machine_stall": 0.1}
FINE |= {"memory_growth": 1.01, "full_disk_told": True, "second_refused": True}


def test_no_good_frame_is_lost_or_doubled_by_kills_and_floods():
    found = bench_hostile_service(messages=240, objects=3, pace=20.0, seed=0)
    assert [found[name] for name in ("valid", "answered", "lost", "doubled", "hostile")] == [48, 48, 0, 0, 192]
    assert 0 < found["tracked"] <= 48 - found["late"] - found["unconfirmed"]
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


# The benchmark of wrong clocks: its figures, and what falls short

SIGMA = np.full(2, 0.002)


def test_a_row_for_each_fault_and_a_word_for_what_falls_short(monkeypatch):
    monkeypatch.setattr(clocks, "FAULTS", (ClockFault("steady", 1.0), ClockFault("glitch", 8.0, 2)))
    monkeypatch.setattr(clocks, "RADAR_RATES", (5.0,))
    monkeypatch.setattr(clocks, "wrong_clock", lambda _, wrong, rate, fault, seed: 0.5 if wrong == "radar" else 1.0)
    found = fault_rows(0)
    assert [figures for _, figures in (next(found), next(found))] == [
        {"fault of the clock": name, "of the radar, radar at 5 Hz": 50.0, "of the lidar, radar at 5 Hz": 100.0}
        for name in ("+1 s", "+8 s, 2 frames")
    ]
    with pytest.raises(SagaError, match=r"\+1 s, of the radar, radar at 5 Hz: 50.0 % tracked; \+8 s, 2 frames"):
        next(found)


def test_offsets_are_judged_by_estimate_and_positions():
    good = offset_figures(np.array([0.003, -0.004]), SIGMA, np.full(2, 0.102), 0.1)
    assert good == pytest.approx(
        {
            "largest error, ms": 4.0,
            "rms error, ms": 3.5355339,
            "within two deviations, %": 100.0,
            "error of positions, m": 0.102,
            "by that without an offset": 1.02,
        }
    )
    assert offset_shortcomings(good) == []
    poor = offset_figures(np.array([0.02, np.nan]), SIGMA, np.full(2, 0.2), 0.1)
    assert poor["within two deviations, %"] == 0.0
    assert [text.split(",")[0] for text in offset_shortcomings(poor)] == [
        "estimate off by nan ms",
        "error of positions 2.000 times that without an offset",
    ]


# `python -m benchmarks streaming` on a short recording: it counts what was put in, and compares with the whole


def test_memory_is_read_and_the_labels_are_those_of_the_whole(bench):
    *read, whole, short = bench("streaming --objects 5 --seconds 5 --compared 6")
    assert whole["boxes"] > 100
    assert short["off by at most, m"] < 1e-3
    assert short["boxes of one alone"] <= short["boxes"] / 50
    assert short["MB at once"] > 0.1
    assert read[-1]["read, s"] == 5.0
    assert whole["peak / first quarter's"] == pytest.approx(read[-1]["most so far, MB"] / read[0]["most so far, MB"])


# The benchmark of speed: rows with ratios and growth; memory of a frame grows with the number of objects

FEW, MANY = 1000, 3000


def test_every_method_has_a_row_for_every_case(bench):
    rows = bench("speed --sizes 5,100,120 --frames 2 --round-trips 2")
    cost = [row for row in rows if row["table"] == "CPU time a frame"]
    cases = [f"{size} {ties}" for ties in ("loose", "dense") for size in (5, 100, 120)]
    assert [(row["case"], row["method"]) for row in cost] == [(c, m) for c in cases for m in METHODS]
    for row in cost:
        base = next(other for other in cost if (other["case"], other["method"]) == (row["case"], "centerpoint"))
        assert row["/ centerpoint"] == pytest.approx(row["ms"] / base["ms"])
        assert 0 < row["ms"] <= row["p99"]
        assert min(row["MB"], row["/ 100 filters"], row["/ SVD"]) > 0
    shares = [row for row in rows if row["table"] == "shares of the stages"]
    assert {row["method"] for row in shares} == {"saga", "kf"}
    for row in shares:
        assert sum(value for value in row.values() if isinstance(value, float)) == pytest.approx(1.0)
    grown = {(row["case"], row["method"]) for row in rows if row["table"] == "growth"}
    assert grown == {(ties, m) for ties in ("loose", "dense") for m in METHODS}
    assert 0 < rows[-1]["p50"] <= rows[-1]["p99"]


def peak(count: int, ties: Ties, method: Method) -> int:
    """Largest number of bytes that a frame allocates, once tracks are there; seen from a vehicle."""
    frames = [replace(frame, world_T_ego=np.eye(4)) for frame in speed_frames(count, ties, 4, seed=0)]
    tracker = speed_config(ties).new_tracker(method)
    for frame in frames[:-1]:
        tracker.step(frame)
    tracemalloc.start()
    tracker.step(frames[-1])
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


@pytest.mark.parametrize(("ties", "method"), [("dense", "saga"), ("loose", "centerpoint")])
def test_no_array_of_a_frame_holds_all_pairs_of_objects(ties, method):
    few, many = peak(FEW, ties, method), peak(MANY, ties, method)
    assert many < 3.5 * few  # an array of all pairs, of one byte each, would make it more
    if ties == "loose":
        assert many < 2 * MANY**2  # bytes
