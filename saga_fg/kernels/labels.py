"""Labels as numbers."""

from __future__ import annotations

import numpy as np

from saga_fg.kernels.array_types import CodeArray, IntArray
from saga_fg.kernels.compilation import kernel


@kernel("u2c")
def numbered_rows(characters: CodeArray) -> tuple[IntArray, IntArray]:
    """For n labels as rows of characters (n, w): the number (n,) of each among those that differ, in order of
    appearance, and the first row (k,) of each of these."""
    n, w = characters.shape
    number, first = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    k, guess = 0, 0
    for i in range(n):
        found = -1
        for c in range(k):  # most often the one of the row before
            candidate = (guess + c) % k
            at, same = first[candidate], True
            for p in range(w):
                if characters[i, p] != characters[at, p]:
                    same = False
                    break
                if characters[i, p] == 0:
                    break
            if same:
                found = candidate
                break
        if found < 0:
            found = k
            first[k] = i
            k += 1
        number[i], guess = found, found
    return number, first[:k].copy()
