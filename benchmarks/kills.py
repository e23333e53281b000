"""kill -9 at random moments: whether outputs are whole or absent afterwards, and what a second run makes of them.

Each command runs twice undisturbed on simulated traffic. Files that differ between these two, such as records of
times, must be whole JSON, HTML or ZIP after a kill; all others must be equal to those of the first run to the byte, or
absent. A folder that a command writes in one step is there with all its files or not at all. The process is killed
with all that it has started, and every few kills the same command runs to its end in the folder that is left.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated
from uuid import uuid4

import numpy as np
import typer

from benchmarks.runner import PROGRAM, Rows, Seed, chosen, each
from benchmarks.scans import SimulatedScans, write_recording
from data_tools.files import LEFTOVER
from pipelines.scale_out.run import OF_THE_RUN

RECORDINGS = (
    "nuscenes",
    "--dataroot",
    "../sim",
    "--split",
    "all",
    "--detections",
    "lidar=../sim/detections/lidar.json",
)
MARK = "SAGA_FG_KILLED"  # in the environment of everything that a command starts
IN_A_ROW = 4  # kills before a command runs to its end
SCANS = 20  # of the recording of `slam`
PATIENCE = 600.0  # s for a run that is not killed


@dataclass(frozen=True)
class Killed:
    """A command, and what it writes: `output` appears in one step, or file by file where it is done in parts."""

    arguments: tuple[str, ...]
    output: str
    in_parts: bool = False


COMMANDS = {
    "track": Killed(("track", *RECORDINGS, "--output", "tracks.json"), "tracks.json"),
    "track --workers": Killed(("track", *RECORDINGS, "--output", "run", "--workers", "2"), "run", True),
    "track --ray": Killed(("track", *RECORDINGS, "--output", "run", "--workers", "2", "--ray", "local"), "run", True),
    "smooth": Killed(("smooth", *RECORDINGS, "--output", "labels"), "labels"),
    "smooth --workers": Killed(("smooth", *RECORDINGS, "--output", "labels", "--workers", "2"), "labels", True),
    "benchmark": Killed(("benchmark", *RECORDINGS, "--output", "figures", "--workers", "1"), "figures", True),
    "slam": Killed(("slam", "scans", "../scans", "--output", "slam"), "slam"),
}


def kills(
    times: Annotated[int, typer.Option("--times", min=1, help="Kills of each command.")] = 100,
    commands: Annotated[
        str, typer.Option("--commands", help="Which, with commas between them.  [default: all]", metavar="NAME,...")
    ] = ",".join(COMMANDS),
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes.")] = 3,
    seed: Seed = 0,
) -> Rows:
    """Kill commands at random moments, and look at what they leave.

    \b
    Examples:
      python -m benchmarks kills --times 10 --commands track,smooth
      python -m benchmarks kills --commands "track --workers,benchmark"
      python -m benchmarks kills --json figures.json
    """
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        place = Path(folder)
        write_recording(SimulatedScans(seed, SCANS), place / "scans")
        _run(place, ("simulate", "--output", "sim", "--scenes", str(scenes), "--seed", str(seed)))
        for name in chosen("--commands", commands, tuple(COMMANDS)):
            yield f"{times} kills each", {"command": name, **_killed(COMMANDS[name], place, times, rng)}


def _killed(command: Killed, place: Path, times: int, rng: np.random.Generator) -> dict[str, int]:
    """Counts of what was found after `times` kills and after the runs that went on from there."""
    folders = [place / name for name in ("first", "second", "killed")]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    begin = time.monotonic()
    first, second = (_whole(command, folder) for folder in folders[:2])
    duration = (time.monotonic() - begin) / 2
    fixed = {name: each for name, each in first.items() if second.get(name) == each and not _of_the_run(name)}
    work, found = folders[2], {"killed": 0, "ended before": 0, "damaged": 0, "resumed": 0, "resumed and equal": 0}
    for number in each(range(times), " ".join(command.arguments[:2])):
        ended = _kill(work, command.arguments, rng.uniform(0, duration))
        found["ended before" if ended else "killed"] += 1
        damage = _damage(_files(work), fixed, first, command)
        found["damaged"] += bool(damage)
        for one in damage:
            typer.echo(f"kill {number}: {one}", err=True)
        if number % IN_A_ROW == IN_A_ROW - 1 or number == times - 1:
            end = _whole(command, work)
            same = end.keys() == first.keys() and all(end[name] == content for name, content in fixed.items())
            found["resumed"] += 1
            found["resumed and equal"] += same
            if not same:
                other = [name for name in end.keys() | first.keys() if end.get(name) != fixed.get(name, end.get(name))]
                typer.echo(f"kill {number}: not as without kills: {sorted(other)[:5]}", err=True)
            shutil.rmtree(work)
            work.mkdir()
    return found


def _whole(command: Killed, folder: Path) -> dict[str, bytes]:
    """The files that a run to the end leaves."""
    _run(folder, command.arguments)
    return {name: content for name, content in _files(folder).items() if not name.endswith(".lock")}


def _run(folder: Path, arguments: Sequence[str]) -> None:
    done = subprocess.run([*PROGRAM, *arguments], cwd=folder, capture_output=True, text=True, timeout=PATIENCE)
    if done.returncode:
        raise RuntimeError(f"saga-fg {' '.join(arguments)}: exit code {done.returncode}:\n{done.stderr}")


def _kill(folder: Path, arguments: Sequence[str], after: float) -> bool:
    """Kill a command and what it has started `after` s; whether it had ended by then."""
    mark = uuid4().hex
    process = subprocess.Popen(
        [*PROGRAM, *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {MARK: mark},
        start_new_session=True,
    )
    with suppress(subprocess.TimeoutExpired):
        process.wait(after)
    ended = process.poll() is not None
    while alive := _marked(mark):
        for number in alive:
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        process.poll()
    process.wait()
    return ended


def _marked(mark: str) -> list[int]:
    """Processes that live with the mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z" and f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


def _files(folder: Path) -> dict[str, bytes]:
    """Content by name of all files, without those that have a temporary name or are in such a folder."""
    found = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and not any(LEFTOVER.fullmatch(part) for part in name.parts):
            found[name.as_posix()] = path.read_bytes()
    return found


def _damage(
    left: Mapping[str, bytes], fixed: Mapping[str, bytes], first: Mapping[str, bytes], command: Killed
) -> list[str]:
    """What is wrong with the files that a killed command left."""
    wrong = []
    for name, content in left.items():
        if _of_the_run(name):
            wrong += [f"{name}: broken"] if name.endswith(".json") and not _is_json(content) else []
        elif name not in first:
            wrong.append(f"{name}: not written without a kill")
        elif name in fixed and content != fixed[name]:
            wrong.append(f"{name}: {len(content)} bytes, not the {len(fixed[name])} of a whole run")
        elif name not in fixed and not _is_whole(name, content):
            wrong.append(f"{name}: broken")
    there = {name for name in left if name.startswith(f"{command.output}/")}
    if there and not command.in_parts:
        missing = sorted(name for name in first if name.startswith(f"{command.output}/") and name not in there)
        wrong += [f"{name}: missing, others are there" for name in missing]
    return wrong


def _of_the_run(name: str) -> bool:
    """True for records of a run, which hold its times: two runs may round them alike."""
    return any(part in OF_THE_RUN for part in Path(name).parts)


def _is_whole(name: str, content: bytes) -> bool:
    """Whether a file of an unknown content has its end."""
    if name.endswith(".json"):
        return _is_json(content)
    if name.endswith(".html"):
        return content.rstrip().endswith(b"</html>")
    if name.endswith(".png"):
        return content.endswith(b"IEND\xaeB`\x82")
    if name.endswith(".zip"):
        file = io.BytesIO(content)
        return zipfile.is_zipfile(file) and zipfile.ZipFile(file).testzip() is None
    return bool(content)


def _is_json(content: bytes) -> bool:
    try:
        json.loads(content)
    except ValueError:
        return False
    return True
