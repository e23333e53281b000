"""A table of a stranger: looked at, tracked by the command that is printed, judged beside his truth, shown."""

from __future__ import annotations

import csv
import json
import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from pipelines.cli import app
from pipelines.report.run_record import read_run_record

RNG = np.random.default_rng(11)
T0 = 1_700_000_000_000_000_000


def saga_fg(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run_line(line: str) -> Result:
    words = shlex.split(line)
    assert words[0] == "saga-fg"
    return saga_fg(*words[1:])


def rows() -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Detections in no order, with other names, ns, degrees and percent; and true objects."""
    found, true = [], []
    for k in range(40):
        for n in range(6):
            way = 1 if n % 2 else -1
            x, y = 500 + way * (k * 1.1 - 14 * (n // 2)), 50.0 + 4 * (n % 2)
            box = {"l": 4.5, "w": 1.9, "h": 1.6, "hdg": 0.0 if way > 0 else 180.0}
            stamp = T0 + k * 100_000_000
            true.append({"ts_ns": stamp, "object_id": f"v{n}", "category": "VEHICLE", "pos_x": x, "pos_y": y, **box})
            at = {"pos_x": x + RNG.normal(0, 0.1), "pos_y": y + RNG.normal(0, 0.1)}
            found.append({"ts_ns": stamp, "category": "VEHICLE", **at, **box, "conf": RNG.uniform(60, 95)})
    RNG.shuffle(found)
    return found, true


def write(path: Path, table: list[dict[str, Any]]) -> Path:
    if path.suffix == ".csv":
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)
    else:
        pa = pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
        import pyarrow.parquet

        pyarrow.parquet.write_table(pa.Table.from_pylist(table), path)
    return path


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ts_ns": lambda t: t + 10**12}, "expected tracks at the times of the ground truth"),
        ({"scene": lambda _: "b"}, None),
    ],
)
def test_tracks_that_do_not_fit_the_truth(tmp_path: Path, change: dict[str, Any], message: str | None) -> None:
    _, true = rows()
    gt = write(tmp_path / "gt.csv", true)
    moved = write(tmp_path / "t.csv", [row | {name: f(row.get(name)) for name, f in change.items()} for row in true])
    result = saga_fg("evaluate", "file", moved, "--truth", gt, "--units", "angle=deg")
    assert (result.exit_code, result.stderr.startswith("error: ")) == ((2, True) if message else (0, False))
    assert message is None or message in result.stderr


@pytest.mark.parametrize(
    ("theirs", "alone", "classes"),
    [
        ({"v0": "X"}, "tracks of X and true objects of BUS", "BUS=X"),
        ({"v0": "coach", "v1": "VEHICLE"}, "tracks of coach and true objects of BUS", "BUS=coach"),
        ({"v0": "VEHICLE"}, "true objects of BUS", None),
        ({"v0": "coach", "v2": "Y"}, "tracks of Y, coach and true objects of BUS", "BUS=coach"),
    ],
)
def test_each_class_without_a_counterpart_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, theirs: dict[str, str], alone: str, classes: str | None
) -> None:
    true = [row | ({"category": "BUS"} if row["object_id"] == "v0" else {}) for row in rows()[1]]
    gt = write(tmp_path / "gt.csv", true)
    other = write(tmp_path / "t.csv", [row | {"category": theirs.get(row["object_id"], "VEHICLE")} for row in true])
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


@pytest.mark.parametrize("verb", ["track", "smooth"])
def test_what_looks_wrong_is_told_once_with_what_mends_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, verb: str
) -> None:
    table = write(tmp_path / "d.csv", rows()[0])
    output = tmp_path / ("t.csv" if verb == "track" else "labels")
    assert saga_fg(verb, "file", table, "--sort", "--output", output).exit_code == 0
    told = [record.getMessage() for record in caplog.records]
    for mend in ("--units angle=deg", "--units score=percent"):
        assert len([line for line in told if line.endswith(f"add {mend}")]) == 1, told


def added(text: str) -> list[str]:
    """The options that a warning or a look says to add."""
    (mend,) = re.findall(r"; (?:fill in and )?add (--\S+ \S+)$", text, re.MULTILINE)
    return shlex.split(str(mend))


UNITS, CLASSES = ("--units", "angle=deg,score=percent"), ("--classes", "VEHICLE=car")


@pytest.mark.parametrize(
    ("renamed", "given", "option"),
    [
        ({"l": "wid", "w": "len"}, [*UNITS, *CLASSES], ["--columns", "length=wid,width=len"]),
        ({"l": "width", "w": "length"}, [*UNITS, *CLASSES], ["--columns", "length=width,width=length"]),
        ({}, ["--units", "score=percent", *CLASSES], ["--units", "score=percent,angle=deg"]),
        ({"category": "kind"}, ["--columns", "label=kind", *UNITS], ["--classes", "VEHICLE=car"]),
    ],
)
@pytest.mark.parametrize("command", ["inspect", "track"])
def test_what_is_told_mends_it_when_pasted(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    command: str,
    renamed: dict[str, str],
    given: list[str],
    option: list[str],
) -> None:
    found = [{renamed.get(name, name): value for name, value in row.items()} for row in rows()[0]]
    table = write(tmp_path / "d.csv", sorted(found, key=lambda row: row["ts_ns"]))

    def told(*more: str) -> list[str]:
        caplog.clear()
        output = [] if command == "inspect" else ["--output", tmp_path / "t.csv"]
        result = saga_fg(*(["inspect"] if command == "inspect" else ["track", "file"]), table, *given, *more, *output)
        assert result.exit_code == 0, result.output
        lines = [*(record.getMessage() for record in caplog.records), *result.stdout.splitlines()]
        return [line for line in lines if "; add --" in line]

    (doubt,) = told()
    assert shlex.split(doubt.rpartition("; add ")[2]) == option
    assert not told(*option)


@pytest.mark.parametrize("command", ["inspect", "track"])
def test_classes_that_are_numbers_are_to_be_filled_in(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, command: str
) -> None:
    found = [{**row, "category": n % 2} for n, row in enumerate(rows()[0])]
    table = write(tmp_path / "d.csv", found)
    units = ["--units", "angle=deg,score=percent"]
    if command == "inspect":
        text = saga_fg("inspect", table, *units).stdout
        assert "saga-fg track file" in text.split("Next, with what fits in place of ...:")[1]
        assert "--classes 0=...,1=... " in text.split("Next, with what fits in place of ...:")[1]
    else:
        assert saga_fg("track", "file", table, *units, "--sort", "-o", tmp_path / "t.csv").exit_code == 0
        text = caplog.text
    assert "objects are tracked one by one; fill in and add --classes 0=...,1=..." in text
    pasted = saga_fg("track", "file", table, "--classes", "0=...,1=...", "-o", tmp_path / "t.csv")
    assert pasted.exit_code == 2
    assert "--classes: 0=...: expected a name in place of the dots" in pasted.stderr


def test_settings_for_a_class_or_sensor_that_the_data_lack(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = write(tmp_path / "d.csv", rows()[0])
    config = tmp_path / "c.yaml"
    options = ("--sort", "--classes", "VEHICLE=car", "--units", "angle=deg,score=percent", "-o", tmp_path / "t.csv")
    for name, warnings in (("Car", 2), ("car", 1)):
        caplog.clear()
        config.write_text(f"tracker: {{classes: {{{name}: {{gate: 0.99}}}}}}\nsensors: {{lidar_top: {{}}}}\n")
        assert saga_fg("track", "file", table, "--config", config, *options).exit_code == 0
        told = [record.getMessage() for record in caplog.records]
        assert len(told) == warnings, told
        assert told[-1].startswith("sensors.lidar_top has settings and the data have none of it; sensor have")


def test_a_look_at_true_objects_names_what_judges_with_them(tmp_path: Path) -> None:
    table = write(tmp_path / "gt.csv", rows()[1])
    result = saga_fg("inspect", table)
    assert result.exit_code == 0, result.output
    assert f"saga-fg evaluate file tracks.csv --truth {table} --classes VEHICLE=car --units angle=deg" in result.stdout


def test_a_look_at_a_table_that_cannot_be_understood(tmp_path: Path) -> None:
    table = write(tmp_path / "d.csv", [{"foo": 1, "bar": 2}])
    result = saga_fg("inspect", table)
    assert result.exit_code == 2
    assert "the columns there are bar, foo; name it: --columns timestamp=NAME,x=NAME,y=NAME" in result.stderr


def test_a_look_at_a_table_with_faults_shows_what_is_understood(tmp_path: Path) -> None:
    table = tmp_path / "d.csv"
    table.write_text("when,x,y,lenght,label,score\n0,1,2,4.5,car,high\n1,1.5,2,4.5,car,0.5\n")
    result = saga_fg("inspect", table)
    assert result.exit_code == 0, result.output
    assert re.search(r"x +1 +1\.25 +1\.5", result.stdout)
    assert "car: 2, ? x ? x ? m, with interactions" in result.stdout
    wrong, following = result.stdout.split("What looks wrong:")[1].split("Next, with what fits in place of ...:")
    assert "expected a column 'timestamp'" in wrong
    assert "unknown column 'lenght'; did you mean 'length'?" in wrong
    assert "line 2: score: expected a number, got 'high'" in wrong
    assert f"saga-fg track file {table} --columns length=lenght,timestamp=... " in following
    assert "expected a name in place of the dots" in run_line(following.strip().splitlines()[0]).stderr
    told = saga_fg("inspect", table, "--columns", "timestamp=when,length=lenght,score=")
    assert "Nothing looks wrong." in told.stdout


def test_a_look_takes_the_options_that_it_prints(tmp_path: Path) -> None:
    table = write(tmp_path / "d.csv", rows()[0])
    look = saga_fg("inspect", table).stdout
    assert "rows are not in order of time; add --sort" in look
    (options,) = re.findall(r"track file \S+ (.*) --output tracks.csv", look)
    again = saga_fg("inspect", table, *shlex.split(options))
    assert again.exit_code == 0, again.output
    assert "Nothing looks wrong." in again.stdout
    assert f" {options} --output tracks.csv" in again.stdout


def test_numbers_of_frames_taken_for_seconds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    found = [{"frame": k // 2, "x": k // 2 + 20 * (k % 2), "y": 2, "label": "car"} for k in range(40)]
    table = write(tmp_path / "d.csv", found)
    track = ["track", "file", table, "--columns", "time=frame", "-o", tmp_path / "t.csv"]
    assert saga_fg(*track).exit_code == 0
    assert "they look like frames, such as 10 a second; add --units time=10Hz" in caplog.text
    assert "add --units time=10Hz" in saga_fg("inspect", table, "--columns", "time=frame").stdout
    caplog.clear()
    assert saga_fg(*track, "--units", "time=10Hz").exit_code == 0
    assert not caplog.records
    assert saga_fg(*track, "--units", "time=s").exit_code == 0  # they are seconds
    assert not caplog.records


@pytest.mark.parametrize("tracks", [False, True])
def test_boxes_of_argoverse_are_not_taken_for_the_world(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, tracks: bool
) -> None:
    pose = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tz_m": 0.0}
    found = [
        {"log_id": "a", "timestamp_ns": T0 + k * 10**8, "category": "BUS", "score": 0.5, "length_m": 10.0,
         "width_m": 2.5, "height_m": 3.0, "tx_m": 5.0 + k, "ty_m": 1.0, **pose, **({"track_id": 3} if tracks else {})}
        for k in range(30)
    ]  # fmt: skip
    table = write(tmp_path / "d.feather.parquet", found)
    shown = saga_fg("inspect", table).stdout
    command = f"saga-fg track argoverse2 --dataroot ... --detections {table} --output tracks.feather"
    if tracks:
        command = f"saga-fg evaluate argoverse2 {table} --dataroot ..."
    assert shown.endswith(f"Next, with what fits in place of ...:\n  {command}\n")
    if not tracks:
        assert saga_fg("track", "file", table, "--classes", "BUS=bus", "-o", tmp_path / "t.csv").exit_code == 0
        assert f"in the frame of the vehicle, and are taken for the world; read them with the poses of their logs: {command}" in caplog.text  # fmt: skip # noqa: E501


def test_a_look_at_a_table_without_doubts(tmp_path: Path) -> None:
    lines = "".join(f"{k / 10},car,{k},2\n" for k in (*range(10), *range(30, 40)))
    (tmp_path / "d.csv").write_text("timestamp,label,x,y\n" + lines)
    result = saga_fg("inspect", tmp_path / "d.csv")
    assert "Nothing looks wrong." in result.stdout
    assert "20 frames in 3.9 s, 10 Hz, 1 pause, the longest of 2.1 s" in result.stdout
    assert "car: 20, ? x ? x ? m, with interactions" in result.stdout


def test_the_examples_of_the_help_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found, true = rows()
    write(tmp_path / "detections.csv", sorted(found, key=lambda row: row["ts_ns"]))
    write(tmp_path / "truth.csv", true)
    write(tmp_path / "tracks.csv", true)
    text = saga_fg("evaluate", "file", "--help").stdout
    lines = [line.strip() for line in text.replace(" \\\n", " ").splitlines() if "saga-fg evaluate file" in line]
    assert len(lines) == 3
    for line in lines:
        result = run_line(line)
        assert result.exit_code == 0, result.output
