"""Settings by class of object: a class has its own, the entry named default serves all others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import TypeVar

import numpy as np

from saga_fg.numerics.arrays import FloatArray, StrArray, distinct

DEFAULT = "default"  # key of the settings for every class that has none of its own
S = TypeVar("S")


def class_settings(classes: Mapping[str, S], plain: Callable[[], S], label: str) -> S:
    """The settings of a class: its own, else those named default, else the plain ones."""
    found = classes.get(label, classes.get(DEFAULT))
    return plain() if found is None else found


def class_numbers(numbers: Mapping[str, float], plain: Callable[[], float], label: StrArray) -> FloatArray:
    """The number of the class of each label (n,), found as settings are: (n,)."""
    occurring, index = distinct(label)
    return np.array([class_settings(numbers, plain, c) for c in occurring], dtype=np.float64)[index]


def class_values(classes: Mapping[str, S], plain: Callable[[], S], label: StrArray, *names: str) -> FloatArray:
    """The numbers of these names, of the class of each label (n,): a row (n,) for every name."""
    occurring, index = distinct(label)
    number = attrgetter(*names)
    of_classes = [number(class_settings(classes, plain, c)) for c in occurring]
    return np.array(of_classes, dtype=np.float64).reshape(len(occurring), len(names)).T[:, index]
