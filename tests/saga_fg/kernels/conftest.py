"""Tests of kernels need some; without them NumPy would be compared with NumPy."""

import pytest

from saga_fg.kernels.compilation import compiled_kernels


@pytest.fixture(autouse=True, scope="module")
def _kernels():
    if not compiled_kernels():
        pytest.skip("kernels are not compiled here")
