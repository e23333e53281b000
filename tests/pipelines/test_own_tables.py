"""Tables of one's own, and what looks wrong in them. From a stranger's table to a judged result."""

import io
import json
import math
import re
import shlex
import warnings
from importlib.util import find_spec

import numpy as np
import pytest
import yaml

from pipelines.config import load_config
from pipelines.report.page import read_run_record
from saga_fg import Boxes, Detections, Frame
from saga_fg.smoothing import smooth as labelled
from saga_fg.tables import option_text
from saga_fg.tracking import Tracker
from saga_fg.types.road_map import RoadMap
from tests.pipelines.strangers_tables import T0, rows, run_line, saga_fg, write


def test_overlaps_are_those_that_both_have(tmp_path):
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


def test_from_a_strangers_table_to_a_judged_result(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    found, true = rows()
    write(tmp_path / "det.csv", found)
    write(tmp_path / "gt.parquet", true)
    look = saga_fg("inspect", "det.csv")
    assert look.exit_code == 0, look.output
    assert re.search(r"x +4\d\d\.\d+ .* from pos_x", look.stdout)
    assert "det, sensor: 40 frames in 3.9 s, 10 Hz" in look.stdout
    assert "VEHICLE: 240, 4.50 x 1.90 x 1.60 m, without interactions" in look.stdout
    lines = look.stdout.split("Next:\n")[1].splitlines()
    track, report = (line.strip() for line in lines)
    options = "--classes VEHICLE=car --units score=percent,angle=deg --sort"
    assert track == f"saga-fg track file det.csv {options} --output tracks.csv"
    result = run_line(track)
    assert result.exit_code == 0, result.output
    assert not caplog.records
    assert "6 tracks" in result.stdout
    record = read_run_record(tmp_path / "tracks.csv")
    assert record.recordings["units"] == {"score": "percent", "angle": "deg"}

    judge = ("evaluate", "file", "tracks.csv", "--truth", "gt.parquet")
    judged = saga_fg(*judge, "--json", "f.json", "--markdown", "f.md")
    assert judged.exit_code == 0, judged.output
    assert all(len(line) <= 80 for line in judged.stdout.splitlines())
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["sweep"]["car"]["amota"] > 0.9
    assert figures["tracking"]["car"]["switches"] == 0
    assert figures["errors"]["car"]["position"] < 0.2
    assert figures["errors"]["car"]["heading"] < 0.1  # degrees of both tables are rad
    assert "**Tracks beside the ground truth**" in (tmp_path / "f.md").read_text()
    assert "Calibration" in saga_fg(*judge, "--full").stdout
    assert "Calibration" not in judged.stdout

    shown = run_line(f"{report} --truth gt.parquet")
    assert shown.exit_code == 0, shown.output
    assert (tmp_path / "report.html").stat().st_size > 20_000


def test_tracks_of_another_tracker_and_its_own_clock(tmp_path):
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


def test_options_add_to_how_the_run_read_its_tables(tmp_path):
    names = ("zeit_ms", "nr", "ost", "nord")
    lines = [(100 * k, n, k - 12.0 * n, 0.0) for k in range(30) for n in range(3)]
    write(tmp_path / "found.csv", [dict(zip(names, line, strict=True)) for line in lines])
    read = ("--columns", "timestamp=zeit_ms,x=ost,y=nord", "--units", "time=ms")
    assert saga_fg("track", "file", tmp_path / "found.csv", *read, "-o", tmp_path / "tracks.csv").exit_code == 0
    judged = ("evaluate", "file", tmp_path / "tracks.csv", "--truth", tmp_path / "found.csv")
    assert saga_fg(*judged).exit_code == 2
    assert saga_fg(*judged, "--columns", "id=nr").exit_code == 0


def test_tracks_that_do_not_fit_the_truth(tmp_path):
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


def test_what_would_have_matched_is_told_where_nothing_does(tmp_path, caplog):
    rng = np.random.default_rng(0)
    start, velocity = rng.uniform(-50, 50, (6, 2)) + np.array([200, 0]), rng.uniform(-9, 9, (6, 2))
    true = [
        {"time": k / 10, "id": n, "label": "car", "x": x, "y": y}
        for k in range(20)
        for n, (x, y) in enumerate((start + k / 10 * velocity).tolist())
    ]
    gt, exchanged = write(tmp_path / "gt.csv", true), [row | {"x": row["y"], "y": row["x"]} for row in true]
    theirs = write(tmp_path / "t.csv", exchanged)
    judged = saga_fg("evaluate", "file", theirs, "--truth", gt, "--json", tmp_path / "f.json")
    assert judged.exit_code == 0, judged.output
    assert json.loads((tmp_path / "f.json").read_text())["sweep"]["overall"]["amota"] == 0
    assert "with x and y exchanged, they would match 100%" in caplog.text
    caplog.clear()
    assert saga_fg("evaluate", "file", write(tmp_path / "own.csv", true), "--truth", gt).exit_code == 0
    assert "would match" not in caplog.text
    late = write(tmp_path / "late.csv", [row | {"time": row["time"] + 1000} for row in true])
    refused = saga_fg("evaluate", "file", late, "--truth", gt)
    assert "-1000 s later they would fit" in " ".join(refused.stderr.split())


def test_each_class_without_a_counterpart_is_told(tmp_path, caplog):
    for theirs, alone, classes in [
        ({"v0": "X"}, "tracks of X and true objects of BUS", "BUS=X"),
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


def test_decimal_commas_and_other_encodings_are_told_in_one_line(tmp_path):
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
    table.write_bytes("time,x,y,label\n0,1,2,car\n".encode("utf-16"))
    tracked = saga_fg("track", "file", table, "-o", tmp_path / "t.csv")
    assert f"line 1 is in UTF-16; convert the file: iconv -f utf-16 -t utf-8 {table}" in tracked.stderr


def test_the_same_in_a_file_and_in_options(tmp_path):
    found, _ = rows()
    table = write(tmp_path / "d.csv", found)
    how = "columns: {id: name}\nclasses: {VEHICLE: car}\nunits: {angle: deg, score: percent}\nsort: true\n"
    (tmp_path / "how.yaml").write_text(how)
    one = saga_fg("track", "file", table, "--import", tmp_path / "how.yaml", "-o", tmp_path / "a.csv")
    other = saga_fg(
        "track", "file", table, "--classes", "VEHICLE=car", "--units", "angle=deg,score=percent", "--sort",
        "-o", tmp_path / "b.csv",
    )  # fmt: skip
    assert one.exit_code == other.exit_code == 0, one.output + other.output
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    named = saga_fg("track", "file", table, "--columns", "id=name", "-o", tmp_path / "a.csv")
    assert "--columns id=name: there is no column 'name'" in named.stderr
    (tmp_path / "how.yaml").write_text("clases: {VEHICLE: car}\n")
    wrong = saga_fg("track", "file", table, "--import", tmp_path / "how.yaml", "-o", tmp_path / "a.csv")
    assert "how.yaml: clases: unknown key, did you mean 'classes'?" in wrong.stderr


# What `inspect` and `track` say of tables with oddities, and what mends them


UNITS, CLASSES = ("--units", "angle=deg,score=percent"), ("--classes", "VEHICLE=car")


PASTED = [
    ("inspect", {"l": "wid", "w": "len"}, [*UNITS, *CLASSES], ["--columns", "length=wid,width=len"]),
    ("track", {"l": "width", "w": "length"}, [*UNITS, *CLASSES], ["--columns", "length=width,width=length"]),
    ("track", {}, ["--units", "score=percent", *CLASSES], ["--units", "score=percent,angle=deg"]),
    ("inspect", {"category": "kind"}, ["--columns", "label=kind", *UNITS], ["--classes", "VEHICLE=car"]),
    ("track", {"category": "kind"}, ["--columns", "label=kind", *UNITS], ["--classes", "VEHICLE=car"]),
]


def test_what_is_told_mends_it_when_pasted(tmp_path, caplog):
    def told(command: str, *options: str) -> list[str]:
        caplog.clear()
        before, after = (["inspect"], []) if command == "inspect" else (["track", "file"], ["-o", tmp_path / "t.csv"])
        result = saga_fg(*before, tmp_path / "d.csv", *options, *after)
        lines = [*(record.getMessage() for record in caplog.records), *result.stdout.splitlines()]
        lines += [line for line in result.stderr.splitlines() if line.startswith("error: ")]
        found = [line for line in lines if "; add --" in line]
        refused = any("--as-given" in line for line in found)
        assert result.exit_code == (2 if refused else 0), result.output
        return [line.removesuffix("; --as-given reads it as it is") for line in found]

    for command, renamed, given, option in PASTED:
        found = [{renamed.get(name, name): value for name, value in row.items()} for row in rows()[0]]
        write(tmp_path / "d.csv", sorted(found, key=lambda row: row["ts_ns"]))
        (doubt,) = told(command, *given)
        assert shlex.split(doubt.rpartition("; add ")[2]) == option
        assert not told(command, *given, *option)


@pytest.mark.parametrize("command", ["inspect", "track"])
def test_classes_that_are_numbers_are_to_be_filled_in(tmp_path, caplog, command):
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


def test_settings_for_a_class_or_sensor_that_the_data_lack(tmp_path, caplog):
    table = write(tmp_path / "d.csv", rows()[0])
    config = tmp_path / "c.yaml"
    options = ("--sort", "--classes", "VEHICLE=car", "--units", "angle=deg,score=percent", "-o", tmp_path / "t.csv")
    for name, expected in (("Car", 2), ("car", 1)):
        caplog.clear()
        config.write_text(f"tracker: {{classes: {{{name}: {{gate: 0.99}}}}}}\nsensors: {{lidar_top: {{}}}}\n")
        assert saga_fg("track", "file", table, "--config", config, *options).exit_code == 0
        told = [record.getMessage() for record in caplog.records]
        assert len(told) == expected, told
        assert told[-1].startswith("sensors.lidar_top has settings and the data have none of it; sensor have")


def test_looks_at_true_objects_at_none_and_at_scattered_dates(tmp_path):
    table = write(tmp_path / "gt.csv", rows()[1])
    result = saga_fg("inspect", table)
    assert result.exit_code == 0, result.output
    assert f"saga-fg evaluate file tracks.csv --truth {table} --classes VEHICLE=car --units angle=deg" in result.stdout
    table = write(tmp_path / "d.csv", [{"foo": 1, "bar": 2}, {"foo": 3, "bar": 2}])
    result = saga_fg("inspect", table)
    assert result.exit_code == 0, result.output
    assert re.search(r"not read: +bar: 2, \.\.\.\n  not read: +foo: 1, 3, \.\.\.", result.stdout)
    assert "the columns there are bar, foo; name it: --columns timestamp=NAME,x=NAME,y=NAME" in result.stdout
    assert f"track file {table} --columns timestamp=...,x=...,y=... " in result.stdout
    table = write(tmp_path / "d.csv", [{**GOOD, "timestamp": "2024-05-01"}] * 3)
    look = saga_fg("inspect", table)
    assert "timestamp: expected times with the time of day" in look.stdout
    assert "Next, when the table is mended:" in look.stdout


def test_a_count_of_frames_is_proposed_as_time_with_its_rate(tmp_path):
    table = tmp_path / "d.csv"
    table.write_text("frame,label,x,y\n" + "".join(f"{k},car,{k},0\n" for k in range(9)))
    look = saga_fg("inspect", table).stdout
    assert f"saga-fg track file {table} --columns timestamp=frame --units time=10Hz --output tracks.csv" in look
    assert "name it: --columns timestamp=frame --units time=10Hz\n" in look
    look = saga_fg("inspect", table, "--units", "time=20Hz").stdout
    assert f"saga-fg track file {table} --columns timestamp=frame --units time=20Hz --output tracks.csv" in look
    assert "name it: --columns timestamp=frame\n" in look


def test_what_a_file_for_import_says_of_tracks_is_no_fault_of_detections(tmp_path):
    how = tmp_path / "how.yaml"
    how.write_text("columns: {id: object_no, score: certain}\n")
    table = tmp_path / "d.csv"
    table.write_text("timestamp,label,x,y,certain\n" + "".join(f"{k},car,{k},0,0.9\n" for k in range(9)))
    look = saga_fg("inspect", table, "--import", how).stdout
    assert "Nothing looks wrong." in look
    assert f"saga-fg track file {table} --import {how} --output tracks.csv" in look
    named = saga_fg("inspect", table, "--import", how, "--columns", "id=number").stdout
    assert "--columns id=number: there is no column 'number'" in named


def test_a_look_at_a_table_with_faults_shows_what_is_understood(tmp_path):
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


def test_a_look_takes_the_options_that_it_prints(tmp_path):
    table = write(tmp_path / "d.csv", rows()[0])
    look = saga_fg("inspect", table).stdout
    assert "rows are not in order of time; add --sort" in look
    (options,) = re.findall(r"track file \S+ (.*) --output tracks.csv", look)
    again = saga_fg("inspect", table, *shlex.split(options))
    assert again.exit_code == 0, again.output
    assert "Nothing looks wrong." in again.stdout
    assert f" {options} --output tracks.csv" in again.stdout


def test_numbers_of_frames_taken_for_seconds(tmp_path, caplog):
    found = [{"frame": k // 2, "x": k // 2 + 20 * (k % 2), "y": 2, "label": "car"} for k in range(40)]
    table = write(tmp_path / "d.csv", found)
    track = ["track", "file", table, "--columns", "time=frame", "-o", tmp_path / "t.csv"]
    refused = saga_fg(*track)
    assert refused.exit_code == 2
    assert "they look like frames, such as 10 a second; add --units time=10Hz" in refused.output
    assert "add --units time=10Hz" in saga_fg("inspect", table, "--columns", "time=frame").stdout
    caplog.clear()
    assert saga_fg(*track, "--units", "time=10Hz").exit_code == 0
    assert not caplog.records
    for unit in ("time=s", "timestamp=s"):  # they are seconds
        assert saga_fg(*track, "--units", unit).exit_code == 0
        assert not caplog.records


def test_seconds_taken_for_numbers_of_frames(tmp_path):
    found = [{"time": k / 20, "x": k / 2 + 20 * (k % 2), "y": 2, "label": "car"} for k in range(40)]
    track = ["track", "file", write(tmp_path / "d.csv", found), "--units", "time=20Hz", "-o", tmp_path / "t.csv"]
    refused = saga_fg(*track)
    assert refused.exit_code == 2
    assert "no whole numbers: they look like seconds; add --units time=s" in refused.output
    assert saga_fg(*track, "--as-given").exit_code == 0


def test_boxes_of_argoverse_are_not_taken_for_the_world(tmp_path, caplog):
    for tracks in [False, True]:
        pose = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tz_m": 0.0}
        found = [
            {"log_id": "a", "timestamp_ns": T0 + k * 10**8, "category": "BUS", "score": 0.5, "length_m": 10.0,
             "width_m": 2.5, "height_m": 3.0, "tx_m": 5.0 + k, "ty_m": 1.0,
             **pose, **({"track_id": 3} if tracks else {})}
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


def test_a_look_at_a_table_without_doubts(tmp_path):
    lines = "".join(f"{k / 10},car,{k},2\n" for k in (*range(10), *range(30, 40)))
    (tmp_path / "d.csv").write_text("timestamp,label,x,y\n" + lines)
    result = saga_fg("inspect", tmp_path / "d.csv")
    assert "Nothing looks wrong." in result.stdout
    assert "20 frames in 3.9 s, 10 Hz, 1 pause, the longest of 2.1 s" in result.stdout
    assert "car: 20, ? x ? x ? m, with interactions" in result.stdout


def test_the_examples_of_the_help_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, true = rows()
    found, in_rad = ([{**row, "hdg": math.radians(row["hdg"])} for row in each] for each in (found, true))
    found = [{**row, "conf": row["conf"] / 100} for row in found]
    write(tmp_path / "detections.csv", sorted(found, key=lambda row: row["ts_ns"]))
    write(tmp_path / "truth.csv", in_rad)
    write(tmp_path / "tracks.csv", in_rad)
    text = saga_fg("evaluate", "file", "--help").stdout
    lines = [line.strip() for line in text.replace(" \\\n", " ").splitlines() if "saga-fg evaluate file" in line]
    assert len(lines) == 3
    for line in lines:
        result = run_line(line)
        assert result.exit_code == 0, result.output


POSE = {"ego_x": 0.0, "ego_y": 0.0, "ego_yaw": 0.0}
GOOD = {"timestamp": 0.0, "x": 1.0, "y": 2.0, "scene": "a", "vx": 0.5, "length": 4.0, **POSE}


def test_a_look_refuses_what_track_refuses_and_both_name_file_and_row(tmp_path):
    for row, message in [
        ({"x": 2e9}, "line 5: x: expected a finite number within 1e+09, got 2e+09"),
        ({"length": 0}, "line 5: length: expected a positive number of metres, got 0"),
        ({"ego_yaw": 1.0}, "line 6: ego_x, ego_y, ego_z, ego_yaw: expected one pose at one time"),
        ({"scene": "n" * 300}, "line 5: scene: expected a name of at most 256 characters"),
    ]:
        found = [{**GOOD, "scene": name, "timestamp": k} for k, name in enumerate("abcd")]
        table = write(tmp_path / "d.csv", [*found[:3], found[3] | row, found[3]])
        tracked = saga_fg("track", "file", table, "--output", tmp_path / "t.csv")
        assert tracked.exit_code == 2
        assert tracked.stderr.startswith(f"error: {table}: ")
        assert message in tracked.stderr
        look = saga_fg("inspect", table)
        assert message in look.stdout + look.stderr
        assert look.exit_code == 2 or "Next, when the table is mended:" in look.stdout


def test_a_look_sees_scenes_that_are_scattered_in_a_long_table(tmp_path, monkeypatch):
    monkeypatch.setattr("data_tools.datasets.detection_files.dataset.ROWS", 3)
    table = write(tmp_path / "d.csv", [{**GOOD, "scene": name, "timestamp": k} for k, name in enumerate("aabbaabb")])
    look = saga_fg("inspect", table).stdout
    assert "rows are not in order of time; add --sort" in look
    assert "--sort --output tracks.csv" in look


# Recorded traffic that is odd: a vehicle in the middle of another, a lane that ends, lights nobody reports

SIZE, SPEED = (4.5, 1.8, 1.5), 8.0


def frame(time: float, cars: list[tuple[float, float]], road: RoadMap | None = None) -> Frame:
    """Cars (x, y) that drive along x."""
    n = len(cars)
    position = np.column_stack([np.array(cars).reshape(-1, 2), np.zeros(n)])
    boxes = Boxes.of(["car"] * n, position, np.tile(SIZE, (n, 1)), np.zeros(n))
    return Frame(time, "lidar", Detections(boxes, np.full(n, 0.9)), road_map=road)


def new_tracker() -> Tracker:
    tracker = load_config("traffic").new_tracker("saga")
    assert isinstance(tracker, Tracker)
    return tracker


def test_a_vehicle_that_appears_in_the_middle_of_another_is_predicted_all_the_same(subtests):
    for apart in [0.0, 1e-9, 0.5, 2.0]:
        with subtests.test(apart=apart):
            tracker = new_tracker()
            for k in range(20):
                x = SPEED * k / 10
                tracker.step(frame(k / 10, [(x, 0.0)] if k < 10 else [(x, 0.0), (x + apart, 0.0)]))
            predicted = tracker.predict([1.0, 5.0], joint=True)
            assert len(predicted) >= 1
            assert np.isfinite(predicted.position).all()
            assert (np.linalg.eigvalsh(predicted.position_covariance) > 0).all()
            assert predicted.joint_covariance is not None
            assert (np.linalg.eigvalsh(predicted.joint_covariance) > -1e-6).all()
            first = predicted.position[:, np.argmin(predicted.id), 0]
            assert SPEED * 1.9 < first[0] < first[1] < SPEED * 1.9 + 1.2 * SPEED * 5


def test_dense_traffic_is_recognised_unless_it_is_said_otherwise(tmp_path):
    """Ten vehicles with headings at 10 Hz, from a sensor of which no pose is given."""
    rows = [f"{k / 10},car,{k - 12 * n},{4 * (n % 2)},0.0" for k in range(20) for n in range(10)]
    table = tmp_path / "above.csv"
    table.write_text("\n".join(["timestamp,label,x,y,yaw", *rows]) + "\n")
    assert "Dense road traffic: 10 vehicles at a time with headings, 10 Hz" in saga_fg("inspect", table).stdout
    told, same = tmp_path / "told.csv", tmp_path / "same.csv"
    line = "settings for dense traffic: 10 vehicles at a time with headings"
    assert saga_fg("track", "file", table, "--output", told).output.count(line) == 1
    saga_fg("track", "file", table, "--settings", "dense", "--output", same)
    assert same.read_bytes() == told.read_bytes()
    config = tmp_path / "c.yaml"
    config.write_text("tracker: {max_coasting: 3.0}\n")
    said = saga_fg("track", "file", table, "--config", config, "--output", tmp_path / "own.csv").output
    assert f"{config}: over plain settings; 10 vehicles at a time with headings" in said
    assert "--settings dense takes those for dense traffic" in said
    assert "settings for" not in saga_fg("track", "file", table, "--settings", "plain", "--output", same).output
    assert same.read_bytes() != told.read_bytes()
    assert "settings for" not in saga_fg("track", "file", table, "--method", "centerpoint", "--output", same).output


def test_labels_of_dense_traffic_begin_with_its_settings_as_those_of_a_program_do(tmp_path):
    pandas = pytest.importorskip("pandas")
    table = tmp_path / "above.csv"
    rows = [f"{k / 10},car,{k - 12 * n},{4 * (n % 2)},0.0,9" for k in range(20) for n in range(10) if n or k % 3]
    table.write_text("\n".join(["timestamp,label,x,y,yaw,lane", *rows]) + "\n")
    found = {}
    for like in (None, "dense", "plain"):
        options = () if like is None else ("--settings", like)
        said = saga_fg("smooth", "file", table, *options, "--output", tmp_path / f"labels-{like}")
        assert said.exit_code == 0, said.output
        assert said.output.count("settings for dense traffic: 10 vehicles at a time with headings") == (like is None)
        assert said.output.count("not read: lane") == 1
        found[like] = (tmp_path / f"labels-{like}" / "labels.csv").read_text()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            boxes = labelled(pandas.read_csv(table), like).boxes()
        assert boxes.x.to_numpy() == pytest.approx(pandas.read_csv(io.StringIO(found[like])).x.to_numpy(), abs=1e-3)
    assert found["dense"] == found[None] != found["plain"]
    truth = tmp_path / "truth.csv"
    truth.write_text(table.read_text().replace("lane", "id"))
    judged = saga_fg("evaluate", "labels", "file", tmp_path / "labels-None", "--detections", table, "--truth", truth)
    assert "settings for dense traffic" in judged.output


def test_what_mends_the_truth_alone_is_named_by_its_own_option(tmp_path):
    gt = write(tmp_path / "gt.csv", rows()[1])
    how = tmp_path / "how.yaml"
    how.write_text("classes: {VEHICLE: car}\n")
    result = saga_fg("evaluate", "file", gt, "--units", "angle=deg", "--truth", gt, "--truth-import", how)
    assert 'add --truth-import (units: {"angle": "deg"}); --truth-import (as_given: true) reads it' in result.output
    text = option_text({"columns": {"x": "pos: e", "y": "no"}, "as_given": True}, "--truth-import")
    read = yaml.safe_load(f"{{{text.partition('(')[2][:-1]}}}")
    assert read == {"columns": {"x": "pos: e", "y": "no"}, "as_given": True}
    how.write_text("classes: {VEHICLE: car}\nunits: {angle: deg}\n")
    options = ("--units", "angle=deg", "--classes", "VEHICLE=car")
    assert saga_fg("evaluate", "file", gt, *options, "--truth", gt, "--truth-import", how).exit_code == 0
