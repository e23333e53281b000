"""What `inspect` and `track` say of tables with oddities, and what mends them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from tests.pipelines.strangers_tables import T0, rows, run_line, saga_fg, write


def test_what_looks_wrong_is_told_once_with_what_mends_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    table = write(tmp_path / "d.csv", rows()[0])
    assert saga_fg("smooth", "file", table, "--sort", "--output", tmp_path / "labels").exit_code == 0
    told = [record.getMessage() for record in caplog.records]
    for mend in ("--units angle=deg", "--units score=percent"):
        assert len([line for line in told if line.endswith(f"add {mend}")]) == 1, told


def added(text: str) -> list[str]:
    """The options that a warning or a look says to add."""
    (mend,) = re.findall(r"; (?:fill in and )?add (--\S+ \S+)$", text, re.MULTILINE)
    return shlex.split(str(mend))


UNITS, CLASSES = ("--units", "angle=deg,score=percent"), ("--classes", "VEHICLE=car")


PASTED = [
    ("inspect", {"l": "wid", "w": "len"}, [*UNITS, *CLASSES], ["--columns", "length=wid,width=len"]),
    ("track", {"l": "width", "w": "length"}, [*UNITS, *CLASSES], ["--columns", "length=width,width=length"]),
    ("track", {}, ["--units", "score=percent", *CLASSES], ["--units", "score=percent,angle=deg"]),
    ("inspect", {"category": "kind"}, ["--columns", "label=kind", *UNITS], ["--classes", "VEHICLE=car"]),
    ("track", {"category": "kind"}, ["--columns", "label=kind", *UNITS], ["--classes", "VEHICLE=car"]),
]


def test_what_is_told_mends_it_when_pasted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def told(command: str, *options: str) -> list[str]:
        caplog.clear()
        before, after = (["inspect"], []) if command == "inspect" else (["track", "file"], ["-o", tmp_path / "t.csv"])
        result = saga_fg(*before, tmp_path / "d.csv", *options, *after)
        assert result.exit_code == 0, result.output
        lines = [*(record.getMessage() for record in caplog.records), *result.stdout.splitlines()]
        return [line for line in lines if "; add --" in line]

    for command, renamed, given, option in PASTED:
        found = [{renamed.get(name, name): value for name, value in row.items()} for row in rows()[0]]
        write(tmp_path / "d.csv", sorted(found, key=lambda row: row["ts_ns"]))
        (doubt,) = told(command, *given)
        assert shlex.split(doubt.rpartition("; add ")[2]) == option
        assert not told(command, *given, *option)


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


def test_boxes_of_argoverse_are_not_taken_for_the_world(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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


POSE = {"ego_x": 0.0, "ego_y": 0.0, "ego_yaw": 0.0}
GOOD = {"timestamp": 0.0, "x": 1.0, "y": 2.0, "scene": "a", "vx": 0.5, "length": 4.0, **POSE}


def test_a_look_refuses_what_track_refuses_and_both_name_file_and_row(tmp_path: Path) -> None:
    for row, message in [
        ({"x": 2e9}, "line 5: x: expected a finite number within 1e+09, got 2e+09"),
        ({"y": -1e300}, "line 5: y: expected a finite number within 1e+09, got -1e+300"),
        ({"vx": 1e7}, "line 5: vx: expected a finite number within 1e+06, got 1e+07"),
        ({"length": 1e6}, "line 5: length: expected a finite number within 100000, got 1e+06"),
        ({"length": 0}, "line 5: length: expected a positive number of metres, got 0"),
        ({"ego_x": 1e12}, "line 5: ego_x: expected a finite number within 1e+09, got 1e+12"),
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


def test_a_look_sees_scenes_that_are_scattered_in_a_long_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_tools.datasets.detection_files.dataset.ROWS", 3)
    table = write(tmp_path / "d.csv", [{**GOOD, "scene": name, "timestamp": k} for k, name in enumerate("aabbaabb")])
    look = saga_fg("inspect", table).stdout
    assert "rows are not in order of time; add --sort" in look
    assert "--sort --output tracks.csv" in look


def test_a_look_says_that_dates_are_no_times(tmp_path: Path) -> None:
    table = write(tmp_path / "d.csv", [{**GOOD, "timestamp": "2024-05-01"}] * 3)
    look = saga_fg("inspect", table)
    assert "timestamp: expected times with the time of day" in look.stdout
    assert "Next, when the table is mended:" in look.stdout
