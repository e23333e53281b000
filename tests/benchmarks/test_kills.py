"""The benchmark of kills finds files that are not whole, and kills what a command has started."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import kills
from benchmarks.kills import Killed, _damage, _kill, _marked

FIRST = {"labels/a.csv": b"1,2\n", "labels/b.json": b'{"time": 1}', "tracks.json": b"[1, 2]"}
FIXED = {name: FIRST[name] for name in ("labels/a.csv", "tracks.json")}
STEP, PARTS = Killed((), "labels"), Killed((), "labels", in_parts=True)


def test_what_is_not_whole_is_damage(subtests: pytest.Subtests) -> None:
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


def test_all_that_a_command_has_started_is_killed(monkeypatch, tmp_path: Path):
    sleep = "import time; time.sleep(60)"
    start = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {sleep!r}], start_new_session=True)"
    marks = []
    monkeypatch.setattr(kills, "PROGRAM", (sys.executable, "-c"))
    monkeypatch.setattr(kills, "_marked", lambda mark: marks.append(mark) or _marked(mark))
    assert not _kill(tmp_path, (start,), 1.0)
    assert not _marked(marks[0])
    assert _kill(tmp_path, ("pass",), 30.0)


def test_a_command_that_writes_into_its_place_is_found(monkeypatch, tmp_path: Path):
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
