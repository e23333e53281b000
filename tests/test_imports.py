"""Cost and direction of imports."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {"open3d", "scipy.stats", "matplotlib", "typer", "rich", "pandas", "dash", "torch"}


def loaded_by(statement: str) -> set[str]:
    """The modules that a fresh interpreter holds after `statement`."""
    code = f"{statement}\nimport json, sys\nprint(json.dumps(list(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
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
