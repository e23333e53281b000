"""SIGTERM: exit code 143, one line, no temporary file, no process left, and what was complete is kept."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.pipelines.command import COMMAND
from tests.pipelines.scale_out_example import write_recordings

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
def test_while_the_output_is_written(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    recording = long_recording(tmp_path)
    output = tmp_path / ("labels" if arguments[0] == "smooth" else "tracks.csv")
    if output.suffix:
        output.write_text("earlier")
    process = start(tmp_path, *arguments, recording, "--output", output)
    assert terminate(process, lambda: there(tmp_path, ".*.tmp")) == LINE
    assert left_behind(tmp_path) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({"in", "tmp", output.name} - {"labels"})
    assert not output.suffix or output.read_text() == "earlier"


def test_while_slam_writes_its_folder(tmp_path: Path) -> None:
    process = start(tmp_path, "slam", "simulated", "--duration", "2", "--output", tmp_path / "street")
    assert terminate(process, lambda: there(tmp_path, ".street.*.tmp/*")) == LINE
    assert left_behind(tmp_path) == []
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]


def test_with_workers(tmp_path: Path) -> None:
    write_recordings(tmp_path / "in", 12, rows=40)
    out = tmp_path / "out"
    arguments = ["smooth", "file", tmp_path / "in" / "*.csv", "--workers", "2", "--output", out]
    assert terminate(start(tmp_path, *arguments), lambda: there(out, "manifest/*.json")) == LINE
    assert left_behind(tmp_path) == []
    done = {path: path.stat().st_mtime_ns for path in out.glob("manifest/*.json")}
    assert 1 <= len(done) < 12
    again = start(tmp_path, *arguments)
    said, _ = again.communicate()
    assert again.returncode == 0
    assert f"12 scenes: {12 - len(done)} done, {len(done)} unchanged, 0 failed" in said
    assert {path: path.stat().st_mtime_ns for path in done} == done


@pytest.mark.parametrize("module", ["typer.core", "gtsam.gtsam"])
def test_while_modules_are_imported(tmp_path: Path, module: str) -> None:
    """Python says on stderr what it has imported, so that the signal can come in between."""
    recording = long_recording(tmp_path)
    arguments = ("track", "file", recording, "--output", tmp_path / "t.csv")
    process = start(tmp_path, *arguments, python=("-X", "importtime"))
    assert process.stderr is not None
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
import logging, os, pathlib, pkgutil, shutil, signal, sys, tempfile, time, weakref
import numpy as np
from data_tools.files.atomic_files import atomic_directory, write_text
from pipelines.cli.termination import Terminated, ignore_sigterm, raise_on_sigterm
from pipelines.scale_out import OutputFolder
from saga_fg.numerics.arrays import distinct

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

folder = pathlib.Path(sys.argv[1])
(folder / "keep").touch()
logging.disable()  # that kernels are compiled
path, _, name = sys.argv[2].rpartition(".")
owner = pkgutil.resolve_name(path)
original = getattr(owner, name)
raise_on_sigterm()
try:
    setattr(owner, name, signalled)
    exec(sys.argv[3])
    while True:
        time.sleep(0.001)
except Terminated:
    ignore_sigterm()
    print("terminated")
"""


@pytest.mark.parametrize("moment", MOMENTS)
def test_at_moments_when_an_exception_would_leave_something(tmp_path: Path, moment: str) -> None:
    command = [sys.executable, "-B", "-c", SCRIPT, str(tmp_path), *MOMENTS[moment]]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=environment)
    assert (run.stdout, run.stderr, run.returncode) == ("terminated\n", "", 0)
    assert [path for path in tmp_path.rglob("*") if ".tmp" in path.name or path.name.startswith("tmp")] == []


def test_where_it_is_swallowed_it_comes_again() -> None:
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
