"""Made tables in other conventions: each trap is named, and tables as they should be pass without a word."""

from itertools import cycle

import numpy as np
import pytest

from benchmarks.conventions import KINDS, SPEEDS, TRAPS, table
from saga_fg import InputError
from saga_fg.tables.column_names import TableImport
from saga_fg.tables.data_frames import raw_table, scenes_of
from saga_fg.types.finding import refuse_contradictions

MENDS = {
    "vehicle's frame as world": "--coordinates ego",
    "camera axes": "--coordinates camera",
    "compass": "--units angle=compass",
    "mirrored headings": "--units angle=clockwise",
    "headings in degrees": "--units angle=deg",
    "elapsed ns": "--units time=ns",
    "km/h": "--units speed=km/h",
    "sizes exchanged": "--columns length=width,width=length",
}


def check(made, how=None):
    (scene,) = scenes_of(raw_table(made, how))
    refuse_contradictions(scene.findings or ())


def test_traps_are_named_with_what_mends_them(subtests):
    kinds = cycle(KINDS)
    for number, (trap, change) in enumerate(TRAPS.items()):
        for kind in (next(kinds), next(kinds)):
            made = change(table(kind, np.random.default_rng(number), trap == SPEEDS))
            with subtests.test(trap=trap, kind=kind):
                with pytest.raises(InputError, match=f"add {MENDS[trap]}; --as-given reads"):
                    check(made)
                check(made, TableImport(as_given=True))


def test_right_tables_pass(subtests):
    for number, kind in enumerate(KINDS):
        for speeds in (False, True):
            with subtests.test(kind=kind, speeds=speeds):
                check(table(kind, np.random.default_rng(100 + number), speeds))
