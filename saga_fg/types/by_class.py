"""Settings by class of object: a class has its own, the entry named default serves all others."""

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from saga_fg.numerics import FloatArray, StrArray, distinct

VEHICLES = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle")  # classes of road users with wheels
DEFAULT = "default"  # key of the settings for every class that has none of its own
S = TypeVar("S")
_MAX_KEPT = 512  # tables of numbers; settings that are gone are kept as long
_tables: dict[tuple[int, tuple[str, ...], tuple[str, ...]], tuple[Mapping[str, Any], FloatArray]] = {}


def class_settings(classes: Mapping[str, S], plain: Callable[[], S], label: str) -> S:
    """The settings of a class: its own, else those named default, else the plain ones."""
    found = classes.get(label, classes.get(DEFAULT))
    return plain() if found is None else found


def class_numbers(numbers: Mapping[str, float], plain: Callable[[], float], label: StrArray) -> FloatArray:
    """The number of the class of each label (n,), found as settings are: (n,)."""
    occurring, index = distinct(label)
    return np.array([class_settings(numbers, plain, c) for c in occurring], dtype=np.float64)[index]


def class_values(classes: Mapping[str, S], plain: Callable[[], S], label: StrArray, *names: str) -> FloatArray:
    """The numbers of these names, of the class of each label (n,): a row (n,) for every name.

    They are looked up once for the same settings, which are never changed.
    """
    occurring, index = distinct(label)
    key = id(classes), occurring, names
    known = _tables.get(key)
    if known is None:
        if len(_tables) >= _MAX_KEPT:
            _tables.clear()
        number = attrgetter(*names)
        numbers = [number(class_settings(classes, plain, c)) for c in occurring]
        table = np.array(numbers, dtype=np.float64).reshape(len(occurring), len(names)).T.copy()
        known = _tables[key] = classes, table  # with the settings, so that their id stays theirs
    return known[1].take(index, 1)
