"""`python tests/fuzz_readers.py` in an editable install, stopped and started again."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# setuptools' finder of editable packages: it is asked last, after the folder of the script has been searched
EDITABLE = f"""
import sys
from importlib.machinery import PathFinder

class Finder:
    def find_spec(name, path=None, target=None):
        if name in ("factors", "saga_fg", "data_tools", "pipelines"):
            return PathFinder.find_spec(name, [{str(ROOT)!r}])

sys.path[:] = [path for path in sys.path if path != {str(ROOT)!r}]
sys.meta_path.append(Finder)
"""


def test_a_second_run_goes_on_where_the_first_one_stopped(tmp_path):
    kept = tmp_path / "fuzz-state" / "seed-0.json"
    kept.parent.mkdir()
    kept.write_text(json.dumps({"poses, KITTI": {"inputs": 1000, "refused": 0, "faults": 0}}))
    (tmp_path / "sitecustomize.py").write_text(EDITABLE)
    command = [sys.executable, str(ROOT / "tests" / "fuzz_readers.py"), "--only", "poses, KITTI", "--inputs", "2000"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("2000 inputs") == 1
    (count,) = json.loads(kept.read_text()).values()
    assert (count["inputs"], count["faults"]) == (2000, 0)
    assert 0 < count["refused"] < 1000  # of the second part alone
    assert list(kept.parent.iterdir()) == [kept]
