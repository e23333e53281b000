"""Open3D is importable with what pip installs, and a machine where it is not gets one clear line."""

from __future__ import annotations

import subprocess
import sys

import pytest

from data_tools.lidar.scan import load_open3d
from saga_fg.errors import MissingExtraError


def test_open3d_imports_and_computes_without_a_system_libusb() -> None:
    code = (
        "from data_tools.lidar.scan import load_open3d\n"
        "import numpy as np\n"
        "o3d = load_open3d()\n"
        "assert load_open3d() is o3d\n"
        "points = np.array([[0.0, 0, 0], [0.01, 0, 0], [1, 0, 0]])\n"
        "cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))\n"
        "print(len(cloud.voxel_down_sample(0.1).points))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split()[-1] == "2"


def test_where_open3d_is_missing_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"open3d cannot be imported: .*pip install open3d libusb-package"):
        load_open3d()
