"""Shared by the tests of factors: random problems, and a run in an interpreter of its own."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Callable

import numpy as np
import pytest

PREAMBLE = """
import gtsam
import numpy as np
import factors
from factors import *
"""


def random_covariance(rng: np.random.Generator, dim: int) -> np.ndarray:
    root = rng.normal(size=(dim, dim))
    return root @ root.T + 0.1 * np.eye(dim)


@pytest.fixture
def covariance() -> Callable[[np.random.Generator, int], np.ndarray]:
    return random_covariance


@pytest.fixture
def run_apart() -> Callable[[str], str]:
    """Run code in a new interpreter; a crash there fails the test instead of ending it. Returns what was printed."""

    def run(code: str) -> str:
        script = PREAMBLE + textwrap.dedent(code)
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    return run
