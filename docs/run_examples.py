"""Runs the examples of the documentation: `python docs/run_examples.py README.md docs/*.md`.

Every fenced block of bash or Python is preceded by a comment that says what becomes of it:

    <!-- run -->                    it is run
    <!-- run with recordings -->    it is run where SAGA_FG_DATA names a folder with recordings, else skipped
    <!-- ci -->                     .ci/run runs it, with `--mark ci`, in the root of the repository
    <!-- not run: REASON -->        it is not run

The cells of a notebook (.ipynb) are one such block, which is run. `--write-outputs` runs them one by one and writes
into the notebook what they print and show, without pages larger than `LARGEST`.

The blocks of a page run in order in one temporary folder, bash with `set -euo pipefail`, Python in a fresh interpreter.
With `--jobs N`, so many pages run at a time, and a block's output is printed when it has ended.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"(?:<!-- (?P<mark>[^\n]*?) -->\n)?^```(?P<language>bash|python)\n(?P<code>.*?)^```$", re.M | re.S)
MARKS = ("run", "run with recordings", "ci")
LARGEST = 20_000  # characters of an output in a notebook


@dataclass(frozen=True)
class Example:
    """A fenced block: where it is, how it is marked, what is in it."""

    page: Path
    line: int
    mark: str
    language: str
    code: str


class UnmarkedExampleError(Exception):
    """A block says neither that it is run nor why it is not."""


def examples(page: Path) -> list[Example]:
    """The blocks of a page. Raises `UnmarkedExampleError` for one without a mark."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = [cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        return [Example(page, 1, "run", "python", "\n\n".join("".join(source) for source in cells))]
    found = []
    for match in FENCE.finditer(text):
        line = text.count("\n", 0, match.start("code"))
        mark = match["mark"] or ""
        if mark not in MARKS and not mark.startswith("not run: "):
            raise UnmarkedExampleError(f"{page}:{line}: expected a mark such as <!-- run --> before the block")
        found.append(Example(page, line, mark, match["language"], match["code"]))
    return found


def run(example: Example, folder: Path, environment: dict[str, str], capture: bool) -> tuple[int, str]:
    """Run one block in a folder; its exit code, and what it printed if that is captured."""
    if example.language == "bash":
        command = ["bash", "-euo", "pipefail", "-c", example.code]
    else:
        command = [sys.executable, "-W", "error", "-c", example.code]
    out, error = (subprocess.PIPE, subprocess.STDOUT) if capture else (None, None)
    done = subprocess.run(command, cwd=folder, env=environment, check=False, stdout=out, stderr=error, text=True)
    return done.returncode, done.stdout or ""


def run_page(page: Path, wanted: Iterable[str], environment: dict[str, str], capture: bool) -> list[str]:
    """Run the wanted blocks of a page in one folder; one line for each that failed."""
    failed = []
    with tempfile.TemporaryDirectory() as temporary:
        for example in examples(page):
            where = f"{page}:{example.line}"
            if example.mark not in wanted:
                continue
            if example.mark == "run with recordings" and "SAGA_FG_DATA" not in environment:
                print(f"--- {where}: skipped, SAGA_FG_DATA is not set to a folder with recordings", flush=True)
                continue
            if not capture:
                print(f"--- {where}", flush=True)
            folder = ROOT if example.mark == "ci" else Path(temporary)
            start = time.monotonic()
            code, output = run(example, folder, environment, capture)
            if capture:
                print(f"--- {where} ({time.monotonic() - start:.1f} s)\n{output}", end="", flush=True)
            if code:
                failed.append(f"{where}: exit code {code}")
    return failed


def write_outputs(page: Path) -> None:
    """Run the cells of a notebook, and write what they print, and the value of a last expression, into it."""
    notebook, names = json.loads(page.read_text(encoding="utf-8")), {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, start=1):
        printed, value = io.StringIO(), None
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        with redirect_stdout(printed):
            exec(compile(ast.Module(body, []), str(page), "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), str(page), "eval"), names)
        text = printed.getvalue().splitlines(keepends=True)
        stream = [{"name": "stdout", "output_type": "stream", "text": text}] if text else []
        cell |= {"execution_count": number, "outputs": [*stream, *_shown(value, number)]}
    page.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _shown(value: Any, number: int) -> list[dict[str, Any]]:
    """The output of a cell whose last expression has this value, as text and as HTML."""
    if value is None:
        return []
    texts = {"text/plain": repr(value)}
    if hasattr(value, "_repr_html_"):
        texts["text/html"] = value._repr_html_()
    data = {kind: text.splitlines(keepends=True) for kind, text in texts.items() if len(text) <= LARGEST}
    return [{"data": data, "execution_count": number, "metadata": {}, "output_type": "execute_result"}]


def main() -> int:
    """Run the pages named on the command line; 1 if a block failed."""
    parser = argparse.ArgumentParser(description="Run the examples of the documentation.")
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--mark", choices=MARKS, help="only blocks marked so (default: all but ci)")
    parser.add_argument("--jobs", type=int, default=1, help="pages to run at a time (default: 1)")
    parser.add_argument("--write-outputs", action="store_true", help="write the outputs of notebooks into these")
    arguments = parser.parse_args()
    if arguments.write_outputs:
        for page in arguments.pages:
            write_outputs(page)
        return 0
    environment = dict(os.environ)
    beside = ROOT.parent / "shared" / "data"
    if "SAGA_FG_DATA" in environment or beside.is_dir():  # as an absolute path: examples run in other folders
        environment["SAGA_FG_DATA"] = str(Path(environment.get("SAGA_FG_DATA", beside)).resolve())
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT), *filter(None, [environment.get("PYTHONPATH")])]
    )  # benchmarks
    wanted = (arguments.mark,) if arguments.mark else MARKS[:2]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        results = pool.map(lambda page: run_page(page, wanted, environment, arguments.jobs > 1), arguments.pages)
        failed = [line for of_page in results for line in of_page]
    for line in failed:
        print(f"FAILED {line}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
