"""Promises of docs/security.md on files from outside."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("factors", "saga_fg", "data_tools", "pipelines")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
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


def test_nothing_from_outside_is_executed(subtests: pytest.Subtests) -> None:
    for package in PACKAGES:
        with subtests.test(package=package):
            paths = [path for path in SOURCES if path.relative_to(ROOT).parts[0] == package]
            assert len(paths) > 10
            assert {
                path.name: bad for path in paths if (bad := faults(ast.parse(path.read_text(encoding="utf-8"))))
            } == {}


def test_the_search_finds_what_it_looks_for() -> None:
    bad = "import pickle\nfrom marshal import loads\nyaml.load(x)\nnp.load(p)\nrun(c, shell=True)\neval(x)\n"
    assert len(faults(ast.parse(bad))) == 6
    assert faults(ast.parse("import pickle\npickle.dump(x, file)\n")) == []
    assert faults(ast.parse("import pickle\npickle.dump(x, file)\npickle.load(file)\n")) == ["pickle"]
