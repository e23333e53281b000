"""Every estimator of the toolkit by a recipe: code that makes a fresh one, as text. To test one of ours, add it here.

Users test theirs by `saga_fg.conformance.check_estimator`, whose programs and textbook are those of the suite.
"""

import pytest

ESTIMATORS = [
    pytest.param("saga_fg.estimators:JointKalmanFilter()", id="kalman"),
    pytest.param("saga_fg.estimators:GraphFilter()", id="isam2"),
    pytest.param("saga_fg.estimators:GraphFilter(lag=1.0)", id="fixed-lag"),
]


def maker(recipe):
    module, expression = recipe.split(":")
    return lambda: eval(expression, vars(__import__(module, fromlist=["_"])))
