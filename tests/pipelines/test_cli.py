"""The command as users meet it: help with examples, one-line errors, exit codes, nothing half-written."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from click import Context
from typer.main import get_command

from data_tools.datasets.nuscenes.source import sensor_locations
from data_tools.datasets.source import names
from pipelines.cli import app
from pipelines.cli.start import FIRST
from saga_fg import InputError
from tests.pipelines.command import COMMAND, saga_fg


def commands(group: Any, path: str = "") -> Iterator[str]:
    """All commands by their full names: `track nuscenes`, ..."""
    context = Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if hasattr(command, "list_commands"):
            yield from commands(command, f"{path}{name} ")
        else:
            yield f"{path}{name}"


def test_help_shows_a_worked_example() -> None:
    for command in list(commands(get_command(app))):
        result = saga_fg(*command.split(), "--help")
        assert result.exit_code == 0
        assert f"    saga-fg {command}" in result.stdout
        assert "Example" in result.stdout


def test_version_is_that_of_the_distribution() -> None:
    result = saga_fg("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("saga-fg 0.")


def test_config_prints_yaml_that_leads_to_itself(tmp_path: Path) -> None:
    printed = saga_fg("config", "--full", "--for", "kitti").stdout
    path = tmp_path / "all.yaml"
    path.write_text(printed)
    assert saga_fg("config", "--full", "--for", "file", "--config", path).stdout == printed
    assert set(yaml.safe_load(printed)) == {"tracker", "greedy", "sensors"}


def test_config_begins_with_five_settings_and_leads_to_all(tmp_path: Path) -> None:
    for kind in list(FIRST):
        option = () if kind == "tracking" else (f"--{kind}",)
        printed = saga_fg("config", *option).stdout
        assert len(FIRST[kind]) == 5
        for key in FIRST[kind]:
            value = yaml.safe_load(printed)
            for part in key.split("."):
                value = value[next(iter(value)) if part == "*" else part]
        assert "saga-fg config --full" in printed.splitlines()[0]
        everything = saga_fg("config", "--full", *option).stdout
        assert len(printed) < 0.6 * len(everything)
        path = tmp_path / "first.yaml"
        path.write_text(printed)
        assert saga_fg("config", "--full", *option, "--config", path).stdout == everything
        for kind_of_data in ("nuscenes", "kitti"):
            defaults = saga_fg("config", "--full", "--for", kind_of_data, *option).stdout
            path.write_text(saga_fg("config", "--for", kind_of_data, *option).stdout)
            assert saga_fg("config", "--full", "--for", kind_of_data, *option, "--config", path).stdout == defaults


def test_config_knows_the_settings_of_every_dataset() -> None:
    assert (
        saga_fg("config", "--full", "--for", "argoverse2").stdout
        == saga_fg("config", "--full", "--for", "nuscenes").stdout
    )
    assert saga_fg("config", "--full", "--for", "eth_ucy").stdout == saga_fg("config", "--full").stdout
    assert "unknown dataset 'etc'" in saga_fg("config", "--for", "etc").stderr
    assert "config --for argoverse2" in " ".join(saga_fg("track", "argoverse2", "--help").stdout.split())


def test_a_kind_of_data_without_settings_of_smoothing_is_named() -> None:
    result = saga_fg("config", "--smoothing", "--for", "heterogeneous")
    assert result.exit_code == 2
    assert result.stderr.startswith("error: unknown kind of data for smoothing 'heterogeneous', expected one of: file")


def test_a_file_for_another_command_is_named(tmp_path: Path) -> None:
    path = tmp_path / "smoothing.yaml"
    path.write_text(saga_fg("config", "--smoothing").stdout)
    result = saga_fg("config", "--config", path)
    assert result.exit_code == 2
    assert result.stderr == f"error: {path}: smoothing: unknown section, this is a file for `saga-fg smooth`\n"


def test_a_dataset_in_place_of_what_to_learn_is_answered_with_the_command() -> None:
    result = saga_fg("learn", "kitti")
    assert result.exit_code == 2
    assert "try 'learn noise kitti'" in result.stderr


def test_config_prints_the_simulators_settings_and_markdown() -> None:
    assert "warm_up" in yaml.safe_load(saga_fg("config", "--full", "--simulator").stdout)
    assert "## `tracker.existence`" in saga_fg("config", "--markdown").stdout
    assert "| `warm_up` |" in saga_fg("config", "--markdown", "--simulator").stdout


def test_an_input_error_is_one_line_on_stderr_and_exit_code_2(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("tracker: {max_dely: 3}\n")
    result = saga_fg("config", "--config", path)
    assert result.exit_code == 2
    assert result.stderr == f"error: {path}: tracker.max_dely: unknown key, did you mean 'max_delay'?\n"
    assert result.stdout == ""


def test_verbose_adds_the_traceback(tmp_path: Path) -> None:
    result = saga_fg("config", "--config", tmp_path / "none.yaml", "-v")
    assert result.exit_code == 2
    assert "Traceback (most recent call last)" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("error: ")


WITH_CIRCLES = [
    ("track", "file", "circle.csv", "-o", "out.csv"),
    ("track", "file", "in.csv", "-o", "circle.csv"),
    ("track", "file", "in.csv", "-o", "out.csv", "--config", "circle.csv"),
    ("track", "file", "circle.csv", "-o", "out", "--workers", "1"),
    ("track", "kitti", "--dataroot", "circle.csv", "--detections", "circle.csv", "-o", "out"),
    ("smooth", "file", "circle.csv", "-o", "out"),
    ("slam", "g2o", "circle.csv", "-o", "out"),
    ("explain", "in.csv", "--track", "9" * 5000),
    ("report", "file", "in.csv", "-o", "circle.csv"),
    ("simulate", "-o", "circle.csv", "--scenes", "1"),
    ("demo", "-o", "circle.csv", "--scenes", "1"),
]


def test_links_in_a_circle_and_endless_numbers_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("circle.csv").symlink_to("circle.csv")
    Path("in.csv").write_text("timestamp,x,y\n0,1,2\n")
    for arguments in WITH_CIRCLES:
        result = saga_fg(*arguments)
        assert result.exit_code in (1, 2), (arguments, result.exception)
        assert isinstance(result.exception, SystemExit)
        assert result.stderr.splitlines()[-1].startswith(("error: ", "failed: "))
        assert len(result.stderr) < 500
        assert sorted(path.name for path in tmp_path.iterdir() if path.name != "out") == ["circle.csv", "in.csv"]


def test_a_missing_option_is_explained() -> None:
    result = saga_fg("track", "nuscenes", "--dataroot", "x")
    assert result.exit_code == 2
    assert "--detections" in result.stderr


def test_a_bug_is_not_dressed_up_as_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("pipelines.cli.start.load_config", broken)
    assert isinstance(saga_fg("config").exception, ZeroDivisionError)


def test_sensor_files_are_named() -> None:
    assert sensor_locations(["a.json"]) == {"lidar": "a.json"}
    assert sensor_locations(["lidar=a=b.json", "camera=c"]) == {"lidar": "a=b.json", "camera": "c"}
    with pytest.raises(InputError, match=r"--detections b\.json: expected NAME=FILE, e\.g\. lidar=b\.json"):
        sensor_locations(["a=x", "b.json"])
    with pytest.raises(InputError, match="the sensor a is given twice"):
        sensor_locations(["a=x", "a=y"])


def test_names_are_split_at_commas() -> None:
    assert names("--scenes", "a, b,a,") == ("a", "b")
    with pytest.raises(InputError, match="--scenes: expected names"):
        names("--scenes", " , ")


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_an_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    """Interrupted while it works: exit code 130, one line, no file and no temporary."""
    command = [*COMMAND, "demo", "--output", str(tmp_path / "out"), "--scenes", "50"]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells let background jobs ignore it
    )  # fmt: skip
    while not list(tmp_path.iterdir()) and process.poll() is None:  # the temporary folder: the work has begun
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate()
    assert process.returncode == 130, stderr
    assert stderr.strip().splitlines()[-1] == "interrupted: nothing was written"
    assert stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_an_earlier_result_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "out"
    output.mkdir()
    (output / "index.html").write_text("earlier")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.demo.compare", interrupted)
    result = saga_fg("demo", "--output", output)
    assert result.exit_code == 130
    assert [(path.name, path.read_text()) for path in output.iterdir()] == [("index.html", "earlier")]
    assert list(tmp_path.iterdir()) == [output]


def test_an_output_that_cannot_be_written_is_noticed_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.demo.compare", lambda *_, **__: pytest.fail("work was done"))
    result = saga_fg("demo", "--output", tmp_path / "none" / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {tmp_path / 'none' / 'out'}: not writable")


def test_the_installed_command_runs_on_its_own(tmp_path: Path) -> None:
    """A separate process: a clean stdout, no progress bar where stderr is no terminal."""
    run = subprocess.run([*COMMAND, "config", "--full"], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert run.stderr == ""
    assert json.dumps(yaml.safe_load(run.stdout)["tracker"]["max_delay"]) == "0.5"
