"""From a stranger's table to a judged result."""

from __future__ import annotations

import json
import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from pipelines.report.page import read_run_record
from tests.pipelines.strangers_tables import rows, run_line, saga_fg, write


def test_overlaps_are_those_that_both_have(tmp_path: Path) -> None:
    _, true = rows()
    flat = [{name: value for name, value in row.items() if name != "h"} for row in true]
    unturned = [{name: value for name, value in row.items() if name != "hdg"} for row in true]
    one_unturned = [*true[:-1], {**true[-1], "hdg": ""}]
    expected = ((true, {"2D", "3D"}), (flat, {"2D"}), (unturned, {"centre"}), (one_unturned, {"centre"}))
    for table, overlaps in expected:
        gt = write(tmp_path / "gt.csv", table)
        result = saga_fg(
            "evaluate", "file", gt, "--truth", gt, "--units", "angle=deg", "--hota", "--json", tmp_path / "f.json"
        )
        if find_spec("trackeval") is None:
            pytest.skip("the extra [eval] is not installed")
        assert result.exit_code == 0, result.output
        hota = json.loads((tmp_path / "f.json").read_text())["hota"]["VEHICLE"]
        assert set(hota) == {"threshold", *overlaps}
        assert min(hota[overlap]["hota"] for overlap in overlaps) > 0.99


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_from_a_strangers_table_to_a_judged_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, suffix: str
) -> None:
    monkeypatch.chdir(tmp_path)
    found, true = rows()
    write(tmp_path / f"det{suffix}", found)
    write(tmp_path / f"gt{suffix}", true)
    look = saga_fg("inspect", f"det{suffix}")
    assert look.exit_code == 0, look.output
    assert re.search(r"x +4\d\d\.\d+ .* from pos_x", look.stdout)
    assert "det, sensor: 40 frames in 3.9 s, 10 Hz" in look.stdout
    assert "VEHICLE: 240, 4.50 x 1.90 x 1.60 m, without interactions" in look.stdout
    lines = look.stdout.split("Next:\n")[1].splitlines()
    track, report = (line.strip() for line in lines)
    options = "--classes VEHICLE=car --units score=percent,angle=deg --sort"
    assert track == f"saga-fg track file det{suffix} {options} --output tracks.csv"
    result = run_line(track)
    assert result.exit_code == 0, result.output
    assert not caplog.records
    assert "6 tracks" in result.stdout
    record = read_run_record(tmp_path / "tracks.csv")
    assert record is not None
    assert record.recordings["units"] == {"score": "percent", "angle": "deg"}

    judged = saga_fg(
        "evaluate", "file", "tracks.csv", "--truth", f"gt{suffix}", "--json", "f.json", "--markdown", "f.md"
    )  # fmt: skip
    assert judged.exit_code == 0, judged.output
    assert all(len(line) <= 80 for line in judged.stdout.splitlines())
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["sweep"]["car"]["amota"] > 0.9
    assert figures["tracking"]["car"]["switches"] == 0
    assert figures["errors"]["car"]["position"] < 0.2
    assert figures["errors"]["car"]["heading"] < 0.1  # degrees of both tables are rad
    assert "**Tracks beside the ground truth**" in (tmp_path / "f.md").read_text()
    full = saga_fg("evaluate", "file", "tracks.csv", "--truth", f"gt{suffix}", "--full")
    assert "Calibration" in full.stdout
    assert "Calibration" not in judged.stdout

    shown = run_line(f"{report} --truth gt{suffix}")
    assert shown.exit_code == 0, shown.output
    assert (tmp_path / "report.html").stat().st_size > 20_000


def test_tracks_of_another_tracker_and_its_own_clock(tmp_path: Path) -> None:
    _, true = rows()
    gt = write(tmp_path / "gt.csv", true)
    other = [
        {"time_s": row["ts_ns"] / 1e9 + 0.001, "track": row["object_id"], "type": "auto", "cx": row["pos_x"] + 0.3,
         "cy": row["pos_y"]} for row in true
    ]  # fmt: skip
    theirs = write(tmp_path / "theirs.csv", other)
    result = saga_fg(
        "evaluate", "file", theirs, "--truth", gt, "--classes", "VEHICLE=car,auto=car", "--units", "angle=deg",
        "--columns", "id=track", "--json", tmp_path / "f.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["tracking"]["car"]["recall"] == 1.0
    assert figures["errors"]["car"]["position"] == pytest.approx(0.3, abs=1e-6)
    if find_spec("trackeval") is not None:  # the tracks are points: judged by the distances of centres
        assert figures["hota"]["car"]["centre"]["hota"] > 0.85


def test_tracks_that_do_not_fit_the_truth(tmp_path: Path) -> None:
    for change, message in [
        ({"ts_ns": lambda t: t + 10**12}, "expected tracks at the times of the ground truth"),
        ({"scene": lambda _: "b"}, None),
    ]:
        _, true = rows()
        gt = write(tmp_path / "gt.csv", true)
        moved = write(
            tmp_path / "t.csv", [row | {name: f(row.get(name)) for name, f in change.items()} for row in true]
        )
        result = saga_fg("evaluate", "file", moved, "--truth", gt, "--units", "angle=deg")
        assert (result.exit_code, result.stderr.startswith("error: ")) == ((2, True) if message else (0, False))
        assert message is None or message in result.stderr


def test_each_class_without_a_counterpart_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for theirs, alone, classes in [
        ({"v0": "X"}, "tracks of X and true objects of BUS", "BUS=X"),
        ({"v0": "coach", "v1": "VEHICLE"}, "tracks of coach and true objects of BUS", "BUS=coach"),
        ({"v0": "VEHICLE"}, "true objects of BUS", None),
        ({"v0": "coach", "v2": "Y"}, "tracks of Y, coach and true objects of BUS", "BUS=coach"),
    ]:
        true = [row | ({"category": "BUS"} if row["object_id"] == "v0" else {}) for row in rows()[1]]
        gt = write(tmp_path / "gt.csv", true)
        other = write(tmp_path / "t.csv", [row | {"category": theirs.get(row["object_id"], "VEHICLE")} for row in true])
        caplog.clear()
        judge = ["evaluate", "file", other, "--truth", gt]
        assert saga_fg(*judge, "--units", "angle=deg").exit_code == 0
        assert f"{alone} have no counterpart of their class" in caplog.text
        assert ("name them alike" in caplog.text) == (classes is not None)
        if classes is not None:
            mend = caplog.records[-1].getMessage().rpartition("name them alike: ")[2]
            assert mend == f"--classes {classes} --units angle=deg"
            caplog.clear()
            assert saga_fg(*judge, *shlex.split(mend)).exit_code == 0
            assert "BUS" not in caplog.text


def test_decimal_commas_and_other_encodings_are_told_in_one_line(tmp_path: Path) -> None:
    table = tmp_path / "d.csv"
    table.write_text("time;x;y;length;label\n0,0;1,5;2,5;4,5;car\n0,1;1,6;2,5;4,5;car\n")
    tracked = saga_fg("track", "file", table, "-o", tmp_path / "t.csv")
    text = "line 2: timestamp, x, y, length: expected decimal points, got '0,0'; replace the decimal commas"
    assert tracked.stderr.strip() == f"error: {table}: {text}"
    assert saga_fg("inspect", table).stdout.count(text) == 1
    table.write_bytes("time,x,y,label\n0,1,2,car\n1,1,2,Fußgänger\n".encode("latin-1"))
    tracked = saga_fg("track", "file", table, "-o", tmp_path / "t.csv")
    assert f"{table}: expected text in UTF-8, line 3 is in another encoding, such as Latin-1" in tracked.stderr
    assert f"iconv -f latin1 -t utf-8 {table}" in tracked.stderr


def test_without_truth_it_is_asked_for(tmp_path: Path) -> None:
    result = saga_fg("evaluate", "file", write(tmp_path / "t.csv", rows()[1]))
    assert (result.exit_code, "name it: --truth TABLE" in result.stderr) == (2, True)


def test_the_same_in_a_file_and_in_options(tmp_path: Path) -> None:
    found, _ = rows()
    table = write(tmp_path / "d.csv", found)
    (tmp_path / "how.yaml").write_text("classes: {VEHICLE: car}\nunits: {angle: deg, score: percent}\nsort: true\n")
    one = saga_fg("track", "file", table, "--import", tmp_path / "how.yaml", "-o", tmp_path / "a.csv")
    other = saga_fg(
        "track", "file", table, "--classes", "VEHICLE=car", "--units", "angle=deg,score=percent", "--sort",
        "-o", tmp_path / "b.csv",
    )  # fmt: skip
    assert one.exit_code == other.exit_code == 0, one.output + other.output
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    (tmp_path / "how.yaml").write_text("clases: {VEHICLE: car}\n")
    wrong = saga_fg("track", "file", table, "--import", tmp_path / "how.yaml", "-o", tmp_path / "a.csv")
    assert "how.yaml: clases: unknown key, did you mean 'classes'?" in wrong.stderr
