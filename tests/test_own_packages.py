"""The command takes its own packages where other folders of their names come first."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ENTRY = "from saga_fg.__main__ import main\nif __name__ == '__main__':\n    main()\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working directory with packages of other people; the modules of our own come behind it on the path."""
    for name in ("factors", "data_tools", "pipelines"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise SystemExit('the other {name}')\n")
    for scene in "ab":
        rows = "".join(f"{k / 10},car,{k * 0.8},0\n" for k in range(8))
        (tmp_path / f"{scene}.csv").write_text(f"timestamp,label,x,y\n{rows}")
    (tmp_path / "saga-fg").write_text(ENTRY)  # as pip writes it
    return tmp_path


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([".", str(ROOT), *filter(None, sys.path)])
    environment = os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)


def test_other_packages_do_come_first(folder: Path) -> None:
    assert "the other pipelines" in python(folder, "-c", "import pipelines").stderr


@pytest.mark.parametrize("command", [("-m", "saga_fg"), ("saga-fg",)])
def test_the_command_finds_its_own(folder: Path, command: tuple[str, ...]) -> None:
    run = python(folder, *command, "track", "file", "a.csv", "--output", "tracks.csv")
    assert run.returncode == 0, run.stderr
    assert (folder / "tracks.csv").is_file()


def test_so_do_the_processes_it_starts(folder: Path) -> None:
    run = python(folder, "saga-fg", "track", "file", "a.csv", "b.csv", "--output", "run", "--workers", "2")
    assert run.returncode == 0, run.stderr + run.stdout
    assert len(list((folder / "run" / "tracks").iterdir())) == 2


def test_a_program_is_told_of_another_factors_before_it_is_run(folder: Path) -> None:
    run = python(folder, "-c", "import saga_fg; saga_fg.Tracker()")
    assert "the other factors" not in run.stderr
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: saga_fg needs its package factors in {ROOT}, and Python finds {folder}")
    assert "python -P" in last
    (folder / "factors").rename(folder / "my_factors")
    assert python(folder, "-c", "import saga_fg; saga_fg.Tracker()").returncode == 0


def test_a_program_that_uses_the_library_keeps_its_own_packages(folder: Path) -> None:
    assert "the other pipelines" in python(folder, "-c", "import saga_fg, pipelines").stderr
