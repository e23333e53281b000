"""What works without open3d and the other parts that only some people need."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = """
import sys
class Missing:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing)
"""
OPTIONAL = ("open3d", "libusb_package", "pandas", "pyarrow", "rerun", "ray", "fsspec", "mcap", "trackeval")
LIBRARY = """
from saga_fg import Detection, Detections, Frame, Tracker
tracker = Tracker()
for k in range(5):
    tracks = tracker.step(Frame(k / 10, "lidar", Detections.of([Detection("car", (k * 1.0, 0.0, 0.0))])))
assert len(tracks) == 1
"""


def python(code: str, without: tuple[str, ...], folder: Path) -> subprocess.CompletedProcess[str]:
    code = BLOCK.format(names=without) + code
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


def test_the_tracker_needs_the_numerics_alone(tmp_path: Path) -> None:
    run = python(LIBRARY, (*OPTIONAL, "matplotlib", "typer", "rich"), tmp_path)
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
        run = python(code, OPTIONAL, tmp_path)
        assert run.returncode == 0, run.stderr
    assert (tmp_path / "page.html").is_file()


def test_what_needs_open3d_says_so(tmp_path: Path) -> None:
    code = "from data_tools.lidar.scan_files import load_open3d; load_open3d()"
    run = python(code, OPTIONAL, tmp_path)
    assert "open3d cannot be imported" in run.stderr
    assert "pip install open3d" in run.stderr


def test_the_small_install_is_the_whole_without_open3d() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    whole = {re.split(r"[>=<]", entry)[0]: entry for entry in project["dependencies"]}
    lines = (ROOT / ".ci" / "small-install.txt").read_text(encoding="utf-8").splitlines()
    small = {line for line in lines if not line.startswith("#")}
    assert small == set(whole.values()) - {whole["open3d"], whole["libusb-package"]}
