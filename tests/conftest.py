"""Settings of the whole suite: property tests without deadlines, and where real recordings lie."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile("saga-fg", deadline=None, print_blob=True)
hypothesis.settings.load_profile("saga-fg")

DATA = Path(os.environ.get("SAGA_FG_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings (`SAGA_FG_DATA`); tests that need it are skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real recordings at {DATA}: set SAGA_FG_DATA to the folder that holds nuscenes/ and kitti/")
    return DATA
