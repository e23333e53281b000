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


def fuzz(folder: Path, inputs: int) -> subprocess.CompletedProcess[str]:
    (folder / "sitecustomize.py").write_text(EDITABLE)
    script = ROOT / "tests" / "fuzz_readers.py"
    command = [sys.executable, str(script), "--only", "poses, KITTI", "--inputs", str(inputs)]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_second_run_goes_on_where_the_first_one_stopped(tmp_path):
    first = fuzz(tmp_path, 1000)
    assert first.returncode == 0, first.stderr
    kept = tmp_path / "fuzz-state" / "seed-0.json"
    done = json.loads(kept.read_text())
    assert {name: count["inputs"] for name, count in done.items()} == {"poses, KITTI": 1000}
    assert all(0 < count["refused"] < 1000 for count in done.values())
    done["poses, KITTI"]["refused"] = 0  # as nothing is done again, this stays
    kept.write_text(json.dumps(done))
    more = fuzz(tmp_path, 2000)
    assert more.stdout.count("2000 inputs") == 1
    assert json.loads(kept.read_text())["poses, KITTI"]["refused"] < 1000
    assert list(kept.parent.iterdir()) == [kept]
