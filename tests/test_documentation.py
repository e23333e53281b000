"""The documentation keeps up: settings are complete, examples are marked, links lead somewhere."""

import ast
import json
import pkgutil
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from data_tools import conformance  # noqa: F401 (with all kinds of parts)
from data_tools.simulator import SimulatorSettings
from pipelines.config import TrackConfig
from pipelines.configuration.reading import Listing, Nullable, Schema, Section, Table, settings_of
from pipelines.serving import StreamSettings
from pipelines.slam.configuration import SlamSettings
from saga_fg import Tracker
from saga_fg.parts import KINDS
from saga_fg.smoothing import SmoothingSettings

ROOT = Path(__file__).parents[1]
URLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
ADDRESSES = (
    URLS["Repository"] + "/blob/main",
    URLS["Repository"].replace("github.com", "raw.githubusercontent.com") + "/main",
)
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])
GROUPS = {"saga_fg.scans", *(kind.group for kind in KINDS.values())}


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def code_spans(page: Path) -> list[str]:
    """The texts in backticks outside of code blocks."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    return re.findall(r"`([^`]+)`", text)


def resolves(name: str) -> bool:
    """A module, or an attribute of one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def setting_names(where: str, schema: Schema) -> Iterator[str]:
    """The dotted names at and below one setting; `*` for a key of a table, any of several kinds of a section."""
    yield where
    match schema:
        case Nullable(inner):
            yield from setting_names(where, inner)
        case Table(inner):
            yield from setting_names(f"{where}.*", inner)
        case Listing(items):
            for inner in items:
                yield from setting_names(where, inner)
        case Section(classes):
            for cls in classes:
                for setting in settings_of(cls):
                    yield from setting_names(f"{where}.{setting.name}", setting.schema)


def all_settings() -> set[str]:
    """Every setting by its full name and by every ending of it that has a dot: `tracker.existence.report_above`."""
    files = {
        "smoothing": SmoothingSettings,
        "slam": SlamSettings,
        "limits": StreamSettings,
        "simulator": SimulatorSettings,
    }
    full = {name for root, cls in files.items() for name in setting_names(root, Section((cls,)))}
    full |= {name for item in settings_of(TrackConfig) for name in setting_names(item.name, item.schema)}
    return {".".join(parts[first:]) for name in full for parts in [name.split(".")] for first in range(len(parts) - 1)}


def run_examples(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, ROOT / "docs" / "run_examples.py", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def on_the_site(*pages: tuple[str, str]) -> list[str]:
    """The Markdown of pages (name, Markdown) as the site has it; skips without MkDocs."""
    pytest.importorskip("mkdocs", reason="the site comes with the extra docs")
    code = (
        "import json, sys\n"
        "from types import SimpleNamespace as Some\n"
        "from site_hooks import on_page_markdown\n"
        "pages = json.load(sys.stdin)\n"
        "print(json.dumps([on_page_markdown(text, Some(file=Some(src_uri=uri)), None, None) for uri, text in pages]))"
    )
    command, docs = [sys.executable, "-c", code], ROOT / "docs"
    run = subprocess.run(command, input=json.dumps(pages), capture_output=True, text=True, check=True, cwd=docs)
    found: list[str] = json.loads(run.stdout)
    return found


def test_the_site_has_every_setting():
    (page,) = on_the_site(("configuration.md", "# Configuration"))
    assert page.startswith("# Configuration\n")
    assert {name.split(".")[-1] for name in all_settings()} - {"*"} <= set(re.findall(r"^\| `(\w+)` \|", page, re.M))


def test_links_within_the_documentation_lead_somewhere():
    broken = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^)]+)\)", text):
            assert not target.startswith(ADDRESSES), f"{page_name(page)}: {target} does not work without a network"
            if not target.startswith(("http://", "https://")) and not leads_somewhere(page, target):
                broken.append(f"{page_name(page)} links to {target}")
    assert not broken


def leads_somewhere(page: Path, target: str) -> bool:
    """A file from where the page is, with a heading for what follows `#`."""
    name, _, anchor = target.partition("#")
    linked = (page.parent / name).resolve() if name else page
    if not anchor or not linked.exists():
        return linked.exists()
    headings = re.findall(r"^#+ (.+)$", linked.read_text(encoding="utf-8"), flags=re.M)
    return anchor in {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_names_in_the_documentation_exist():
    """Modules, classes and functions of the packages. Groups of entry points are named like modules."""
    name = re.compile(r"(?<![\w.])(?:factors|saga_fg|data_tools|pipelines)(?:[.:][A-Za-z]\w*)+")
    named = {(page_name(page), found) for page in PAGES for span in code_spans(page) for found in name.findall(span)}
    assert not [(page, found) for page, found in sorted(named) if found not in GROUPS and not resolves(found)]


def test_settings_in_the_documentation_exist():
    """Dotted names that begin with a section of settings; `tracker.graph` may be an attribute of a tracker as well."""
    known = all_settings()
    sections = {name.split(".")[0] for name in known} - {"*"}
    assert {"tracker.existence.report_above", "existence.report_above", "sensors.*.use_velocity"} <= known
    for page in PAGES:
        for span in code_spans(page):
            (name,) = re.findall(r"^[a-z_]+(?:\.(?:[a-z_]+|\*|<name>))+(?=$|: (?!unknown key))", span) or [""]
            name = name.replace("<name>", "*").removesuffix(".*")
            section, _, rest = name.partition(".")
            if (
                not rest
                or section not in sections
                or Path(name).suffix in (".csv", ".json", ".ply", ".py", ".tum", ".txt", ".yaml")
            ):
                continue
            attribute = section == "tracker" and hasattr(Tracker, rest)
            assert name in known or attribute, f"{page_name(page)} names the setting {span}"


def test_the_contents_and_the_site_name_every_page():
    contents = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        assert name == "index.md" or f"]({name})" in contents, f"docs/index.md does not name {name}"
        entry = rf"^ +- (?:[^:]+: )?{re.escape(name)}$"
        assert re.search(entry, navigation, flags=re.M), f"mkdocs.yml does not name {name}"


def test_every_example_says_whether_it_is_run():
    run = run_examples("--mark", "ci", *(page for page in PAGES if page.name != "README.md"))
    assert run.returncode == 0, run.stderr


def test_the_readmes_examples_of_the_library_work():
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
    assert len([line for line in example.splitlines() if line.strip()]) <= 15
    run = subprocess.run([sys.executable, "-W", "error", "-c", example], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "2 car at" in run.stdout  # the hidden car is still there


def test_examples_that_fail_or_are_not_marked_are_reported(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- run -->\n```bash\necho first > a\n```\n\n<!-- run -->\n```python\nopen('a').read(); 1 / 0\n```\n"
    )
    run = run_examples(page)
    assert run.returncode == 1
    assert f"FAILED {page}:7: exit code 1" in run.stdout
    assert "ZeroDivisionError" in run.stderr
    page.write_text("```bash\ntrue\n```\n")
    run = run_examples(page)
    assert run.returncode != 0
    assert f"{page}:1: expected a mark such as <!-- run --> before the block" in run.stderr


def test_pages_run_at_the_same_time_are_told_apart(tmp_path):
    pages = [tmp_path / f"{name}.md" for name in ("good", "bad")]
    for page, ending in zip(pages, ("true", "false"), strict=True):
        page.write_text(f"<!-- run -->\n```bash\necho from {page.stem}\n{ending}\n```\n")
    run = run_examples("--jobs", "2", *pages)
    assert run.returncode == 1
    assert "FAILED" not in run.stdout.replace(f"FAILED {pages[1]}:2: exit code 1", "")
    for page in pages:
        assert re.search(rf"^--- {re.escape(str(page))}:2 \([0-9.]+ s\)\nfrom {page.stem}$", run.stdout, re.M)


def test_notebooks_hold_what_their_cells_show(tmp_path, subtests):
    """Each cell that ends in a value has an output; outputs are written by running the cells."""
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        for cell in cells:
            last = ast.parse("".join(cell["source"])).body[-1]
            shows = isinstance(last, ast.Expr)
            with subtests.test(f"{path.name}, {cell['id']}"):
                assert bool(cell["outputs"]) == shows
    small = {"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": []}
    made = tmp_path / "small.ipynb"
    made.write_text(json.dumps({"cells": [{**small, "source": ["x = 2\n", "print(x)\n", "x + 1"]}]}))
    assert run_examples("--write-outputs", made).returncode == 0
    printed, shown = json.loads(made.read_text())["cells"][0]["outputs"]
    assert (printed["text"], shown["data"]) == (["2\n"], {"text/plain": ["3"]})


def test_ci_runs_the_commands_of_the_readme():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"<!-- ci -->\n```bash\n(.*?)\n```", text) == [
        "pip install -e . && saga-fg demo",
        'pip install -e ".[dev]" && pytest -n 2',
    ]
    assert "run_examples.py --mark ci README.md" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_the_api_reference_names_every_face():
    """Every package with an `__all__`, but the command and the benchmarks, which are documented by what they print."""
    faces = {
        ".".join(face.parent.relative_to(ROOT).parts)
        for top in ("factors", "saga_fg", "data_tools", "pipelines")
        for face in (ROOT / top).rglob("__init__.py")
        if "__all__" in face.read_text(encoding="utf-8")
    }
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    assert faces - {"pipelines.cli"} <= set(re.findall(r"^::: (\S+)$", pages, flags=re.M))


def test_links_to_the_top_of_the_repository_are_links_of_the_site():
    pages = (
        ("index.md", "[a](../CONTRIBUTING.md#b) [c](install.md)"),
        ("guides/slam.md", "[a](../../CHANGELOG.md) [c](../model.md)"),
        ("CONTRIBUTING.md", "[a](docs/guides/slam.md#b)"),
    )
    assert on_the_site(*pages) == [
        "[a](CONTRIBUTING.md#b) [c](install.md)",
        "[a](../CHANGELOG.md) [c](../model.md)",
        "[a](guides/slam.md#b)",
    ]
