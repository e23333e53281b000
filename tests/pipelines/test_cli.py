"""The command: its help, its errors, and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from click import Context
from typer.main import get_command

from data_tools.datasets.nuscenes.source import sensor_locations
from data_tools.datasets.source import names
from pipelines.cli import app
from pipelines.cli.commands import PAGES, location
from pipelines.cli.start import FIRST
from saga_fg import InputError
from tests.pipelines.command import COMMAND, done, refused, saga_fg
from tests.pipelines.scale_out_example import write_recordings


def commands(group: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """All commands by their full names: `track nuscenes`, ..."""
    context = Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if hasattr(command, "list_commands"):
            yield from commands(command, f"{path}{name} ")
        else:
            yield f"{path}{name}", command


def test_help_and_version():
    for command, _ in commands(get_command(app)):
        result = done(*command.split(), "--help")
        assert f"    saga-fg {command}" in result.stdout
        assert "Example" in result.stdout
    result = done("--version")
    assert result.stdout.startswith("saga-fg 0.")


def test_examples_have_the_options_that_their_commands_require():
    for name, command in commands(get_command(app)):
        options = [each.opts[0] for each in command.params if each.required and each.param_type_name == "option"]
        lines = command.help.replace("\\\n", " ").splitlines()
        examples = [line.split() for line in lines if f"saga-fg {name} " in line]
        for option in options:
            assert all(option in example for example in examples), f"{name}: {option}"


def test_config_prints_yaml_that_leads_to_itself(tmp_path):
    printed = saga_fg("config", "--full", "--for", "kitti").stdout
    path = tmp_path / "all.yaml"
    path.write_text(printed)
    assert saga_fg("config", "--full", "--for", "file", "--config", path).stdout == printed
    assert set(yaml.safe_load(printed)) == {"tracker", "greedy", "sensors"}
    assert "warm_up" in yaml.safe_load(saga_fg("config", "--full", "--simulator").stdout)


def test_config_begins_with_five_settings_and_leads_to_all(tmp_path):
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
        assert len(printed) < 0.7 * len(everything)
        path = tmp_path / "first.yaml"
        path.write_text(printed)
        assert saga_fg("config", "--full", *option, "--config", path).stdout == everything
        for kind_of_data in ("nuscenes", "kitti"):
            defaults = saga_fg("config", "--full", "--for", kind_of_data, *option).stdout
            path.write_text(saga_fg("config", "--for", kind_of_data, *option).stdout)
            assert saga_fg("config", "--full", "--for", kind_of_data, *option, "--config", path).stdout == defaults


def test_config_knows_the_settings_of_every_dataset():
    assert (
        saga_fg("config", "--full", "--for", "argoverse2").stdout
        == saga_fg("config", "--full", "--for", "nuscenes").stdout
    )
    assert saga_fg("config", "--full", "--for", "mcap").stdout == saga_fg("config", "--full").stdout
    assert "unknown dataset 'etc'" in saga_fg("config", "--for", "etc").stderr
    assert "config --for argoverse2" in " ".join(saga_fg("track", "argoverse2", "--help").stdout.split())


def test_what_is_asked_of_the_wrong_command_is_answered_with_the_right_one(tmp_path):
    said = refused("config", "--smoothing", "--for", "heterogeneous")
    assert said.startswith("error: unknown kind of data for smoothing 'heterogeneous', expected one of: dense, file")
    path = tmp_path / "smoothing.yaml"
    path.write_text(saga_fg("config", "--smoothing").stdout)
    said = refused("config", "--config", path)
    assert said == f"error: {path}: smoothing: unknown section, this is a file for `saga-fg smooth`\n"
    assert "try 'learn noise kitti'" in refused("learn", "kitti")
    assert "--detections" in refused("track", "nuscenes", "--dataroot", "x")


def test_an_input_error_is_one_line_and_verbose_adds_the_traceback(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("tracker: {max_dely: 3}\n")
    result = saga_fg("config", "--config", path)
    assert result.exit_code == 2
    assert result.stderr == f"error: {path}: tracker.max_dely: unknown key, did you mean 'max_delay'?\n"
    assert result.stdout == ""
    said = refused("config", "--config", tmp_path / "none.yaml", "-v")
    assert "Traceback (most recent call last)" in said
    assert said.splitlines()[-1].startswith("error: ")


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


def test_links_in_a_circle_and_endless_numbers_are_one_line(tmp_path, monkeypatch):
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


def test_a_bug_is_not_dressed_up_as_bad_input(monkeypatch):
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("pipelines.cli.start.load_config", broken)
    assert isinstance(saga_fg("config").exception, ZeroDivisionError)


def test_sensor_files_are_named_and_names_split_at_commas():
    assert sensor_locations(["a.json"]) == {"lidar": "a.json"}
    assert sensor_locations(["lidar=a=b.json", "camera=c"]) == {"lidar": "a=b.json", "camera": "c"}
    with pytest.raises(InputError, match=r"--detections b\.json: expected NAME=FILE, e\.g\. lidar=b\.json"):
        sensor_locations(["a=x", "b.json"])
    with pytest.raises(InputError, match="the sensor a is given twice"):
        sensor_locations(["a=x", "a=y"])
    assert names("--scenes", "a, b,a,") == ("a", "b")
    with pytest.raises(InputError, match="--scenes: expected names"):
        names("--scenes", " , ")


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_an_interrupt_leaves_nothing_behind(tmp_path):
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


def test_an_output_that_cannot_be_written_is_noticed_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.demo.compare", lambda *_, **__: pytest.fail("work was done"))
    said = refused("demo", "--output", tmp_path / "none" / "out")
    assert said.startswith(f"error: {tmp_path / 'none' / 'out'}: not writable")


# `saga-fg docs`: pages of a clone, and addresses without one


def test_a_clone_has_its_pages_and_elsewhere_they_have_addresses(tmp_path):
    run = done("docs", "guides/stream")
    assert Path(run.stdout.strip()).read_text(encoding="utf-8").startswith("# ")
    with pytest.raises(InputError, match=r"unknown page 'formatz'.*formats"):
        location("formatz", PAGES)
    if not metadata("saga-fg").get_all("Project-URL"):
        pytest.skip("the installed metadata is older than the addresses: pip install -e .")
    address = location("formats", tmp_path)
    assert address.startswith("https://")
    assert address.endswith("/docs/formats.md")


# SIGTERM: exit code 143, one line, no temporary file, no process left, and what was complete is kept

LINE = "terminated: what was complete is kept\n"


def start(folder: Path, *arguments: str | Path, python: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    """The command in a session of its own, its temporary files in `folder`/tmp."""
    (folder / "tmp").mkdir(exist_ok=True)
    return subprocess.Popen(
        [COMMAND[0], *python, *COMMAND[1:], *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(folder / "tmp")},
    )


def terminate(process: subprocess.Popen[str], when: Callable[[], object]) -> str:
    """Send SIGTERM as soon as `when` is true; what the process then says on stderr."""
    while not when():
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    process.terminate()
    _, said = process.communicate(timeout=120)
    assert process.returncode == 143, said
    while in_session(process.pid):  # helpers of multiprocessing end by themselves when their pipe closes
        time.sleep(0.01)
    return said


def in_session(session: int) -> list[str]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of_session = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of_session) == session and state != "Z":
            found.append(stat.parent.name)
    return found


def there(folder: Path, pattern: str) -> list[Path]:
    """Files that match a pattern, in folders that may vanish meanwhile."""
    try:
        return list(folder.glob(pattern))
    except FileNotFoundError:
        return []


def left_behind(folder: Path) -> list[Path]:
    return [*folder.rglob("*.tmp"), *folder.rglob(".scratch"), *(folder / "tmp").iterdir()]


def long_recording(folder: Path) -> Path:
    (folder / "in").mkdir()
    write_recordings(folder / "in", 1, rows=4000)
    return folder / "in" / "a00.csv"


@pytest.mark.parametrize("arguments", [("track", "file", "--explain"), ("smooth", "file")])
def test_while_the_output_is_written(tmp_path, arguments):
    recording = long_recording(tmp_path)
    output = tmp_path / ("labels" if arguments[0] == "smooth" else "tracks.csv")
    if output.suffix:
        output.write_text("earlier")
    process = start(tmp_path, *arguments, recording, "--output", output)
    assert terminate(process, lambda: there(tmp_path, ".*.tmp")) == LINE
    assert left_behind(tmp_path) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({"in", "tmp", output.name} - {"labels"})
    assert not output.suffix or output.read_text() == "earlier"


def test_with_workers(tmp_path):
    write_recordings(tmp_path / "in", 12, rows=40)
    out = tmp_path / "out"
    arguments = ["smooth", "file", tmp_path / "in" / "*.csv", "--workers", "2", "--output", out]
    assert terminate(start(tmp_path, *arguments), lambda: there(out, "manifest/*.json")) == LINE
    assert left_behind(tmp_path) == []
    assert 1 <= len(list(out.glob("manifest/*.json"))) < 12


@pytest.mark.parametrize("module", ["typer.core", "gtsam.gtsam"])
def test_while_modules_are_imported(tmp_path, module):
    """Python says on stderr what it has imported, so that the signal can come in between."""
    recording = long_recording(tmp_path)
    arguments = ("track", "file", recording, "--output", tmp_path / "t.csv")
    process = start(tmp_path, *arguments, python=("-X", "importtime"))
    while not (line := process.stderr.readline()).rstrip().endswith(f" {module}"):
        assert line, "the process has ended"
    said = terminate(process, lambda: True)
    assert [line for line in said.splitlines(True) if not line.startswith("import time:")] == [LINE]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "tmp"]


MOMENTS = {
    "a temporary file made": ("pathlib.Path.open", "write_text(folder / 'a', 'x')"),
    "a temporary file moved": ("pathlib.Path.replace", "write_text(folder / 'a', 'x')"),
    "a temporary file removed": ("pathlib.Path.unlink", "write_text(folder / 'a', 'x')"),
    "a temporary folder made": ("pathlib.Path.mkdir", "fill(folder / 'b')"),
    "a temporary folder moved": ("os.replace", "fill(folder)"),
    "a temporary folder removed": ("shutil.rmtree", "fill(folder)"),
    "the system's temporary folder made": ("os.mkdir", "scratch()"),
    "the system's temporary folder removed": ("shutil.rmtree", "scratch()"),
    "results written": ("os.replace", "OutputFolder(folder).write('c/d', b'x')"),
    "a type of a kernel's results looked up": ("numba.cloudpickle.loads", "distinct(LABELS)"),
    "the compiler of kernels made": ("llvmlite.binding.executionengine.ExecutionEngine.__init__", "distinct(LABELS)"),
    "a compiled kernel kept on disk": ("os.replace", "distinct(LABELS)"),
    "a finaliser": ("time.time", "weakref.finalize(set(), lambda: time.time())"),
    "nothing of note": ("time.time", "time.time()"),
}
SCRIPT = """
import json, logging, os, pathlib, pkgutil, shutil, signal, sys, tempfile, time, weakref
import numba
import numpy as np
from data_tools.files.file_access import atomic_directory, write_text
from pipelines.cli.termination import Terminated, ignore_sigterm, raise_on_sigterm
from pipelines.scale_out import OutputFolder

LABELS = np.array(["a", "b", "a"])  # whose kernel has not been compiled

def fill(path):
    with atomic_directory(path) as inner:
        (inner / "sub").mkdir()
        write_text(inner / "sub" / "x", "x")

def scratch():
    with tempfile.TemporaryDirectory(dir=folder):
        pass

def signalled(*arguments, **options):
    setattr(owner, name, original)
    os.kill(os.getpid(), signal.SIGTERM)
    try:
        return original(*arguments, **options)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)

for moment, (where, code) in json.loads(sys.argv[2]).items():  # each in a child of its own
    sys.stdout.flush()
    if not (child := os.fork()):
        break
    print(moment, os.waitpid(child, 0)[1])
else:
    sys.exit()
folder = pathlib.Path(sys.argv[1]) / moment
folder.mkdir()
numba.config.CACHE_DIR = str(folder / "kernels")
from saga_fg.numerics.arrays import distinct

logging.disable()  # that kernels are compiled
path, _, name = where.rpartition(".")
owner = pkgutil.resolve_name(path)
original = getattr(owner, name)
raise_on_sigterm()
try:
    setattr(owner, name, signalled)
    exec(code)
    for _ in range(10_000):
        time.sleep(0.001)
    print("never terminated: ", end="")
except Terminated:
    ignore_sigterm()
    print("terminated: ", end="")
"""


def test_at_moments_when_an_exception_would_leave_something(tmp_path):
    command = [sys.executable, "-B", "-c", SCRIPT, str(tmp_path), json.dumps(MOMENTS)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert run.stdout.splitlines() == [f"terminated: {moment} 0" for moment in MOMENTS]
    assert (run.stderr, run.returncode) == ("", 0)
    assert [path for path in tmp_path.rglob("*") if ".tmp" in path.name or path.name.startswith("tmp")] == []


def test_where_it_is_swallowed_it_comes_again():
    code = """
import os, signal, time
from pipelines.cli.termination import Terminated, raise_on_sigterm
raise_on_sigterm()
swallowed = 0
try:
    while swallowed < 3:
        try:
            if not swallowed:
                os.kill(os.getpid(), signal.SIGTERM)
            while True:
                time.sleep(0.001)
        except Terminated:
            swallowed += 1
    try:
        while True:
            time.sleep(0.001)
    finally:
        time.sleep(0.1)  # it is on its way: nothing comes in between
except Terminated:
    print(swallowed)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert (run.stdout, run.stderr) == ("3\n", "")
