"""Contents of the installed package: the four packages, their data files, the command, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"factors", "saga_fg", "data_tools", "pipelines"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """A wheel built from a copy of the sources, so that nothing of an earlier build gets in."""
    pytest.importorskip("build", reason="the package build comes with the extra dev")
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    shutil.copytree(
        ROOT,
        source,
        ignore=shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "build", "dist"),
        dirs_exist_ok=True,
    )
    run = subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(output), str(source)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    return zipfile.ZipFile(next(output.glob("saga_fg-*.whl")))


def test_the_wheel_holds_exactly_the_four_packages(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES
    assert len(tops) == len(PACKAGES) + 1


def test_the_wheel_holds_every_source_file_and_only_those(wheel: zipfile.ZipFile) -> None:
    inside = {name for name in wheel.namelist() if ".dist-info/" not in name}
    suffixes = {".py", ".pyi", ".yaml", ".html", ".css", ".js", ".typed"}
    expected = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.suffix in suffixes and "__pycache__" not in path.parts
    }
    assert inside == expected


def test_the_wheel_names_licence_command_and_pythons(wheel: zipfile.ZipFile) -> None:
    info = next(name.split("/")[0] for name in wheel.namelist() if ".dist-info/" in name)
    metadata = wheel.read(f"{info}/METADATA").decode()
    assert "License-Expression: Apache-2.0" in metadata
    assert "Requires-Python: <3.14,>=3.11" in metadata
    assert f"{info}/licenses/LICENSE" in wheel.namelist()
    assert "saga-fg = saga_fg.__main__:main" in wheel.read(f"{info}/entry_points.txt").decode()


def test_what_the_wheel_holds_works_on_its_own(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """Configurations and the page of reports are found where the packages are, not where the sources are."""
    wheel.extractall(tmp_path)
    code = (
        "from importlib.resources import files\n"
        "from pipelines.config import load_config\n"
        "import pipelines\n"
        "for family in ('nuscenes', 'kitti', 'simulated', 'file'):\n"
        "    load_config(family)\n"
        "assert (files('pipelines.report') / 'page.html').is_file()\n"
        "print(pipelines.__file__)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert Path(run.stdout.strip()).is_relative_to(tmp_path)
