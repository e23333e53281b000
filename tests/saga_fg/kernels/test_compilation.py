"""Where kernels are used, where they are kept, and what is said of it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import saga_fg
from saga_fg.kernels import compilation
from saga_fg.kernels.compilation import load_kernels

ROOT = Path(saga_fg.__file__).parents[1]
LABELS = (
    "import numpy as np; from saga_fg.numerics.arrays import distinct; print(distinct(np.array(['a', 'b', 'a']))[1])"
)

IMPORTS = """
import contextlib, importlib, pkgutil, sys, factors, saga_fg, data_tools, pipelines
importing = []
for package in (factors, saga_fg, data_tools, pipelines):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        with contextlib.suppress(ImportError):  # of an extra that is not installed
            importlib.import_module(module.name)
        for slow in {"numba", "scipy.stats"} & sys.modules.keys() - dict(importing).keys():
            importing.append((slow, module.name))
print(importing)
"""


def run(code, cwd, **environment):
    """What a fresh interpreter prints, on both streams."""
    run_in = {**os.environ, "PYTHONPATH": str(cwd), **environment}
    done = subprocess.run([sys.executable, "-c", code], cwd=cwd, env=run_in, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr


def test_nothing_slow_is_imported_and_numba_at_the_first_kernel_if_it_is_not_switched_off():
    assert run(IMPORTS, ROOT)[0] == "[]"
    out, said = run(LABELS + "; import sys; print('numba' in sys.modules)", ROOT, NUMBA_DISABLE_JIT="1")
    assert (out.split("\n"), said) == (["[0 1 0]", "False"], "")


def test_a_read_only_installation_keeps_its_kernels_in_the_cache_of_the_user(tmp_path):
    """The second process finds them there; only the first says that it compiles."""
    installed = tmp_path / "installed"
    shutil.copytree(Path(saga_fg.__file__).parent, installed / "saga_fg", ignore=shutil.ignore_patterns("__pycache__"))
    (installed / "saga_fg" / "kernels" / "__pycache__").touch()  # no folder can be made there, not even by root
    cache = tmp_path / "cache"
    environment = {"XDG_CACHE_HOME": str(cache), "NUMBA_CACHE_DIR": "", "PYTHONDONTWRITEBYTECODE": "1"}
    out, said = run(LABELS, installed, **environment)
    assert out == "[0 1 0]"
    assert said.count("compiling kernels") == 1
    assert list(cache.rglob("*.nbi"))
    out, said = run(LABELS, installed, **environment)
    assert out == "[0 1 0]"
    assert "compiling" not in said


def in_one_line(code, **environment):
    """The message of a `KernelError`, which is one line."""
    caught = f"from saga_fg.errors import SagaError\ntry:\n    {code}\nexcept SagaError as error:\n    print(error)"
    out, said = run(caught, ROOT, **environment)
    assert "\n" not in out
    assert "Traceback" not in said
    return out


def test_what_cannot_be_compiled_is_one_clear_line(tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('Numba needs NumPy 2.2 or less')")
    out = in_one_line(LABELS, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert out.startswith("Numba cannot be imported: Numba needs NumPy 2.2 or less")
    assert "pip install" in out
    code = "from saga_fg.kernels.compilation import kernel; kernel('f')(lambda x: x.nothing)(1.0)"
    out = in_one_line(code, NUMBA_CACHE_DIR=str(tmp_path))
    assert out.startswith("kernel <lambda>: Numba ")
    assert "does not compile it" in out


@pytest.mark.parametrize(("suffix", "content"), [("nbi", b""), ("nbc", b"\x80\x04damaged")])
def test_a_damaged_file_of_kernels_is_told_with_its_folder_and_replaced(suffix, content, tmp_path):
    environment = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    run(LABELS, ROOT, **environment)
    kept = list(tmp_path.rglob(f"*.{suffix}"))
    assert kept
    for path in kept:
        path.write_bytes(content)
    out, said = run(LABELS, ROOT, **environment)
    assert out == "[0 1 0]"
    assert said.count(str(kept[0].parent)) == 1
    assert "Traceback" not in said
    assert run(LABELS, ROOT, **environment) == ("[0 1 0]", "")


def test_on_a_full_disk_kernels_are_compiled_once_and_not_kept(tmp_path):
    full = (
        "import numba.core.caching as c\n"
        "def save(*args): raise OSError(28, 'No space left on device')\n"
        "c.IndexDataCacheFile.save = save\n"
    )
    out, said = run(full + LABELS, ROOT, NUMBA_CACHE_DIR=str(tmp_path))
    assert out == "[0 1 0]"
    assert said.count("No space left on device") == 1
    assert str(tmp_path) in said


def test_all_kernels_can_be_loaded_before_the_first_frame(monkeypatch):
    load_kernels()
    sources = [each.source for each in compilation._kernels]
    assert {source.__module__.split(".")[-1] for source in sources} >= {"filtering", "components", "pairs", "paths"}
    monkeypatch.setattr(compilation, "_compiled", None)  # nothing is left to compile
    load_kernels()
