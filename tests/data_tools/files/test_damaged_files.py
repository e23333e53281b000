"""Whatever happens to a file, its reader either reads it or says in one `InputError` what is wrong.

`python tests/fuzz_readers.py` does the same for hours.
"""

from __future__ import annotations

import random
from contextlib import suppress

import pytest
from damage import Target, damaged, targets

from saga_fg import InputError

INPUTS = 60


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("damage"))


def test_what_is_whole_is_read(valid: dict[str, Target]) -> None:
    for target in valid.values():
        target.read()


@pytest.mark.parametrize("seed", range(8))
def test_damage_is_read_or_named(valid: dict[str, Target], seed: int) -> None:
    for number, (name, target) in enumerate(valid.items()):
        rng = random.Random(1000 * seed + number)
        originals = {path: path.read_bytes() for path in target.files}
        for _ in range(INPUTS):
            path = rng.choice(target.files)
            path.write_bytes(damaged(originals[path], rng))
            try:
                with suppress(InputError):
                    target.read()
            except Exception as error:
                raise AssertionError(f"{name}: {path.read_bytes()!r}") from error
            finally:
                path.write_bytes(originals[path])
