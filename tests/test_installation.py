"""What an installation does wherever it is: imports are cheap, packages one's own, optional parts missed by name."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {"open3d", "scipy.stats", "matplotlib", "typer", "rich", "pandas", "dash", "torch"}
OPTIONAL = ("open3d", "libusb_package", "pandas", "pyarrow", "rerun", "ray", "fsspec", "mcap", "trackeval")


def python(folder: Path, *arguments: str, before: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run a fresh interpreter in a folder, whose modules come first if that is said; those of this clone come later."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*before, str(ROOT), *filter(None, sys.path)])}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, cwd=folder, env=environment
    )


# imports


def loaded_by(statement: str) -> set[str]:
    """The modules that a fresh interpreter holds after `statement`."""
    run = python(ROOT, "-c", f"{statement}\nimport json, sys\nprint(json.dumps(list(sys.modules)))")
    return set(json.loads(run.stdout))


def test_importing_a_package_loads_nothing_heavy(subtests: pytest.Subtests) -> None:
    for package in ["factors", "saga_fg", "data_tools", "pipelines"]:
        with subtests.test(package=package):
            assert not loaded_by(f"import {package}") & HEAVY


def test_importing_the_tracker_loads_nothing_heavy_either() -> None:
    assert not loaded_by("from saga_fg import *\nfrom saga_fg.tracking import Tracker") & HEAVY


@pytest.mark.parametrize("module", ["saga_fg.errors", "pipelines.cli.commands"])
def test_errors_and_the_help_of_the_command_answer_before_numpy_is_there(module: str) -> None:
    assert not loaded_by(f"import {module}") & {"numpy", "scipy", "gtsam"}


def test_imports_run_one_way() -> None:
    """pipelines -> data_tools -> saga_fg -> factors, as the contract in pyproject.toml says."""
    pytest.importorskip("importlinter", reason="import-linter comes with the extra dev")
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]
    run = subprocess.run([*command, "--no-cache"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert run.returncode == 0, run.stdout + run.stderr
    assert " 0 broken" in run.stdout


# without what only some people need


BLOCK = """
import sys
class Missing:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing)
"""
LIBRARY = """
from saga_fg import Detection, Detections, Frame, Tracker
tracker = Tracker()
for k in range(5):
    tracks = tracker.step(Frame(k / 10, "lidar", Detections.of([Detection("car", (k * 1.0, 0.0, 0.0))])))
assert len(tracks) == 1
"""


def without(names: tuple[str, ...], code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run code where modules cannot be found."""
    return python(folder, "-c", BLOCK.format(names=names) + code)


def test_the_tracker_needs_the_numerics_alone(tmp_path: Path) -> None:
    run = without((*OPTIONAL, "matplotlib", "typer", "rich"), LIBRARY, tmp_path)
    assert run.returncode == 0, run.stderr


def test_the_command_tracks_and_reports_without_open3d(tmp_path: Path) -> None:
    rows = "".join(f"{k / 10},car,{k * 0.8},0\n" for k in range(10))
    (tmp_path / "d.csv").write_text(f"timestamp,label,x,y\n{rows}")
    for arguments in (
        ["track", "file", "d.csv", "--output", "t.csv"],
        ["smooth", "file", "d.csv", "--output", "labels"],
        ["report", "file", "t.csv", "--detections", "d.csv", "--output", "page.html"],
    ):
        code = f"from pipelines.cli.main import main; sys.argv[1:] = {arguments!r}; main()"
        run = without(OPTIONAL, code, tmp_path)
        assert run.returncode == 0, run.stderr
    assert (tmp_path / "page.html").is_file()


def test_what_needs_open3d_says_so(tmp_path: Path) -> None:
    code = "from data_tools.lidar.scan_files import load_open3d; load_open3d()"
    run = without(OPTIONAL, code, tmp_path)
    assert "open3d cannot be imported" in run.stderr
    assert "pip install open3d" in run.stderr


def test_the_small_install_is_the_whole_without_open3d() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    whole = {re.split(r"[>=<]", entry)[0]: entry for entry in project["dependencies"]}
    lines = (ROOT / ".ci" / "small-install.txt").read_text(encoding="utf-8").splitlines()
    small = {line for line in lines if not line.startswith("#")}
    assert small == set(whole.values()) - {whole["open3d"], whole["libusb-package"]}


# where other packages of the same names come first


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


def beside_others(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return python(folder, *arguments, before=(".",))


def test_other_packages_do_come_first(folder: Path) -> None:
    assert "the other pipelines" in beside_others(folder, "-c", "import pipelines").stderr


@pytest.mark.parametrize("command", [("-m", "saga_fg"), ("saga-fg",)])
def test_the_command_finds_its_own(folder: Path, command: tuple[str, ...]) -> None:
    run = beside_others(folder, *command, "track", "file", "a.csv", "--output", "tracks.csv")
    assert run.returncode == 0, run.stderr
    assert (folder / "tracks.csv").is_file()


def test_so_do_the_processes_it_starts(folder: Path) -> None:
    run = beside_others(folder, "saga-fg", "track", "file", "a.csv", "b.csv", "--output", "run", "--workers", "2")
    assert run.returncode == 0, run.stderr + run.stdout
    assert len(list((folder / "run" / "tracks").iterdir())) == 2


def test_a_program_is_told_of_another_factors_before_it_is_run(folder: Path) -> None:
    run = beside_others(folder, "-c", "import saga_fg; saga_fg.Tracker()")
    assert "the other factors" not in run.stderr
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: saga_fg needs its package factors in {ROOT}, and Python finds {folder}")
    assert "python -P" in last
    (folder / "factors").rename(folder / "my_factors")
    assert beside_others(folder, "-c", "import saga_fg; saga_fg.Tracker()").returncode == 0


def test_a_program_that_uses_the_library_keeps_its_own_packages(folder: Path) -> None:
    assert "the other pipelines" in beside_others(folder, "-c", "import saga_fg, pipelines").stderr
