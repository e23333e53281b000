"""What is distributed, how it is installed, and what is written about its security."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
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


def test_the_wheel_holds_every_source_file_of_the_four_packages(wheel):
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == PACKAGES
    assert len(tops) == len(PACKAGES) + 1
    inside = {name for name in wheel.namelist() if ".dist-info/" not in name}
    suffixes = {".py", ".pyi", ".yaml", ".html", ".css", ".js", ".typed"}
    expected = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.suffix in suffixes and "__pycache__" not in path.parts
    }
    assert inside == expected
    info = next(name.split("/")[0] for name in wheel.namelist() if ".dist-info/" in name)
    metadata = wheel.read(f"{info}/METADATA").decode()
    assert "License-Expression: Apache-2.0" in metadata
    assert "Requires-Python: <3.14,>=3.11" in metadata
    assert f"{info}/licenses/LICENSE" in wheel.namelist()
    assert "saga-fg = saga_fg.__main__:main" in wheel.read(f"{info}/entry_points.txt").decode()


# What an installation does wherever it is: imports are cheap, packages one's own, optional parts missed by name

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


def test_importing_loads_nothing_heavy():
    packages = "import factors, saga_fg, data_tools, pipelines"
    assert not loaded_by(f"{packages}\nfrom saga_fg import *\nfrom saga_fg.tracking import Tracker") & HEAVY


@pytest.mark.parametrize("module", ["saga_fg.errors", "pipelines.cli.commands"])
def test_errors_and_the_help_of_the_command_answer_before_numpy_is_there(module):
    assert not loaded_by(f"import {module}") & {"numpy", "scipy", "gtsam"}


def test_imports_run_one_way():
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


def test_the_tracker_needs_the_numerics_alone_and_what_needs_open3d_says_so(tmp_path):
    run = without((*OPTIONAL, "matplotlib", "typer", "rich"), LIBRARY, tmp_path)
    assert run.returncode == 0, run.stderr
    code = "from data_tools.lidar.scan import load_open3d; load_open3d()"
    run = without(OPTIONAL, code, tmp_path)
    assert "open3d cannot be imported" in run.stderr
    assert "pip install open3d" in run.stderr


def test_the_command_tracks_and_reports_without_open3d(tmp_path):
    rows = "".join(f"{k / 10},car,{k * 0.8},0\n" for k in range(10))
    (tmp_path / "d.csv").write_text(f"timestamp,label,x,y\n{rows}")
    lines = (
        "track file d.csv --output t.csv",
        "smooth file d.csv --output labels",
        "report file t.csv --detections d.csv --output page.html",
    )
    code = f"from pipelines.cli import app\nfor line in {lines}:\n    app(line.split(), standalone_mode=False)"
    run = without(OPTIONAL, code, tmp_path)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "page.html").is_file()


def test_the_small_install_is_the_whole_without_open3d():
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


def test_other_packages_come_first_where_programs_ask_for_them(folder):
    assert "the other pipelines" in beside_others(folder, "-c", "import saga_fg, pipelines").stderr


def test_the_command_finds_its_own(folder):
    run = beside_others(folder, "-m", "saga_fg", "track", "file", "a.csv", "--output", "tracks.csv")
    assert run.returncode == 0, run.stderr
    assert (folder / "tracks.csv").is_file()


def test_so_do_the_installed_one_and_the_processes_it_starts(folder):
    run = beside_others(folder, "saga-fg", "track", "file", "a.csv", "b.csv", "--output", "run", "--workers", "2")
    assert run.returncode == 0, run.stderr + run.stdout
    assert len(list((folder / "run" / "tracks").iterdir())) == 2


def test_a_program_is_told_of_another_factors_before_it_is_run(folder):
    run = beside_others(folder, "-c", "import saga_fg; saga_fg.Tracker()")
    assert "the other factors" not in run.stderr
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: saga_fg needs its package factors in {ROOT}, and Python finds {folder}")
    assert "python -P" in last
    (folder / "factors").rename(folder / "my_factors")
    assert beside_others(folder, "-c", "import saga_fg; saga_fg.Tracker()").returncode == 0


# Promises of docs/security.md on files from outside

SOURCES = sorted(path for package in sorted(PACKAGES) for path in (ROOT / package).rglob("*.py"))
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
FORBIDDEN_CALLS = {"eval", "exec", "yaml.load", "yaml.full_load", "yaml.unsafe_load", "os.system"}


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def faults(tree: ast.AST) -> list[str]:
    """What could run code that a file brings; writing a pickle, which the benchmark of Argoverse 2 wants, does not."""
    found = []
    used = {dotted(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    writes = {use for use in used if use.startswith("pickle.")} == {"pickle.dump"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.split(".")[0] in FORBIDDEN_MODULES]
            found += [name for name in names if name != "pickle" or not writes]
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in FORBIDDEN_MODULES:
            found.append(str(node.module))
        if isinstance(node, ast.Call):
            name, given = dotted(node.func), {word.arg: word.value for word in node.keywords}
            if name in FORBIDDEN_CALLS:
                found.append(name)
            if name == "np.load" and not (
                isinstance(v := given.get("allow_pickle"), ast.Constant) and v.value is False
            ):
                found.append("np.load without allow_pickle=False")
            if isinstance(shell := given.get("shell"), ast.Constant) and shell.value is True:
                found.append("shell=True")
    return found


def test_nothing_from_outside_is_executed(subtests):
    for package in sorted(PACKAGES):
        with subtests.test(package=package):
            paths = [path for path in SOURCES if path.relative_to(ROOT).parts[0] == package]
            assert len(paths) >= 10
            assert {
                path.name: bad for path in paths if (bad := faults(ast.parse(path.read_text(encoding="utf-8"))))
            } == {}


def test_the_search_finds_what_it_looks_for():
    bad = "import pickle\nfrom marshal import loads\nyaml.load(x)\nnp.load(p)\nrun(c, shell=True)\neval(x)\n"
    assert len(faults(ast.parse(bad))) == 6
    assert faults(ast.parse("import pickle\npickle.dump(x, file)\n")) == []
    assert faults(ast.parse("import pickle\npickle.dump(x, file)\npickle.load(file)\n")) == ["pickle"]


@pytest.mark.parametrize(
    ("tag", "heading", "expected"),
    [
        ("v9.9.9", "## Unreleased", r"expected the tag v(\S+), as in pyproject\.toml, got v9\.9\.9"),
        ("", "## Unreleased", r"CHANGELOG\.md: expected the heading '## \S+ \(YYYY-MM-DD\)'"),
        ("", "## 9.9.9 (2030-01-31)", r"CHANGELOG\.md: expected the heading '## \S+ \(YYYY-MM-DD\)'"),
    ],
)
def test_a_release_without_its_heading_or_of_another_tag_is_refused(tmp_path, tag, heading, expected):
    (tmp_path / ".ci").mkdir()
    for name in (".ci/release", "pyproject.toml", "CITATION.cff"):
        shutil.copy(ROOT / name, tmp_path / name)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n{heading}\n")
    command = ["bash", str(tmp_path / ".ci" / "release"), str(tmp_path / "dist"), tag or f"v{version}"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert re.fullmatch(f"error: {expected}\n", run.stderr)
    assert not list((tmp_path / "dist").iterdir())
