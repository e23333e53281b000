import pytest

from tests.saga_fg.every_estimator import ESTIMATORS, maker


@pytest.fixture(params=ESTIMATORS)
def make(request):
    """Makes fresh estimators of the kind under test."""
    return maker(request.param)
