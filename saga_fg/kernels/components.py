"""Components of a joint state whose covariance blocks lie one after the other in one array.

The block of a component of size s begins at its `start`; the covariance of nodes i and j of it, whose states begin at
offset[i] and offset[j], at start + s offset[i] + offset[j], with rows s apart. See `saga_fg.estimators.partition`.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import FloatArray, IntArray
from saga_fg.kernels.compilation import kernel

Tables = tuple[IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray]


@kernel("i1 i1")
def component_tables(label: IntArray, dims: IntArray) -> Tables:
    """Index tables of components, for nodes with component `label` (n,) and states of sizes `dims` (n,).

    group, row (n,) of each node's component; offset (n,) of its state within it; start, size (n,) of the component's
    block; first (n,): where its states begin in `places` (D,), the places of the states in the joint state, group by
    group and component by component. Before it, for all groups, sizes (g,) and counts (g,) of their components.
    """
    n = len(label)
    count = 0
    for i in range(n):
        count = max(count, label[i] + 1)
    of = np.zeros(count, dtype=np.int64)  # sizes of components
    offset = np.empty(n, dtype=np.int64)
    largest, total = 0, 0
    for i in range(n):
        offset[i] = of[label[i]]
        of[label[i]] += dims[i]
        total += dims[i]
    for k in range(count):
        largest = max(largest, of[k])
    number = np.zeros(largest + 1, dtype=np.int64)
    for k in range(count):
        number[of[k]] += 1
    groups = 0
    for s in range(largest + 1):
        groups += number[s] > 0
    sizes, counts = np.empty(groups, dtype=np.int64), np.empty(groups, dtype=np.int64)
    begin, begin_places = np.empty(groups, dtype=np.int64), np.empty(groups, dtype=np.int64)
    g, at, place = 0, 0, 0
    for s in range(largest + 1):
        if number[s] > 0:
            sizes[g], counts[g], begin[g], begin_places[g] = s, number[s], at, place
            at += number[s] * s * s
            place += number[s] * s
            number[s] = g
            g += 1
    used = np.zeros(groups, dtype=np.int64)
    row_of = np.empty(count, dtype=np.int64)
    for k in range(count):
        g = number[of[k]]
        row_of[k] = used[g]
        used[g] += 1
    group, row = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    start, size, first = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    places = np.empty(total, dtype=np.int64)
    state = 0
    for i in range(n):
        k = label[i]
        g, s = number[of[k]], of[k]
        group[i], row[i], start[i], size[i] = g, row_of[k], begin[g] + row_of[k] * s * s, s
        first[i] = begin_places[g] + row_of[k] * s
        to = first[i] + offset[i]
        for e in range(dims[i]):
            places[to + e] = state + e
        state += dims[i]
    return group, row, offset, start, size, first, sizes, counts, places


@kernel("f1 i1 i1 i1 i1 i1 i1 i1 i1 i1 i1 i")
def regrouped_blocks(
    flat: FloatArray,
    label: IntArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    dims: IntArray,
    source: IntArray,
    new_label: IntArray,
    new_start: IntArray,
    new_size: IntArray,
    new_offset: IntArray,
    length: int,
) -> FloatArray:
    """The blocks over another partition: (length,).

    source (n',): of each of its nodes the old one, -1 for none. Between nodes of different components, before or after,
    entries are zero.
    """
    result = np.zeros(length)
    n = len(source)
    count = 0
    for k in range(n):
        count = max(count, new_label[k] + 1)
    of, changed = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=np.bool_)
    for k in range(n):  # components that stay as they are
        i, c = source[k], new_label[k]
        if i < 0 or size[i] != new_size[k] or offset[i] != new_offset[k] or (of[c] >= 0 and start[of[c]] != start[i]):
            changed[c] = True
        else:
            of[c] = i
    for k in range(n):
        c = new_label[k]
        if not changed[c] and of[c] >= 0:
            old, new, area = start[of[c]], new_start[k], new_size[k] * new_size[k]
            for e in range(area):
                result[new + e] = flat[old + e]
            of[c] = -1
    latest, before = np.full(count, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    for k in range(n):  # before[k]: the node of its component that comes before it
        i = source[k]
        if i < 0 or not changed[new_label[k]]:
            continue
        d = dims[i]
        other = k
        while other >= 0:
            j = source[other]
            if label[j] == label[i]:
                e = dims[j]
                old, new = start[i] + size[i] * offset[i] + offset[j], new_start[k] + new_size[k] * new_offset[k]
                new += new_offset[other]
                transposed = start[i] + size[i] * offset[j] + offset[i]
                mirrored = new_start[k] + new_size[k] * new_offset[other] + new_offset[k]
                for a in range(d):
                    for b in range(e):
                        result[new + a * new_size[k] + b] = flat[old + a * size[i] + b]
                        result[mirrored + b * new_size[k] + a] = flat[transposed + b * size[i] + a]
            other = latest[new_label[k]] if other == k else before[other]
        before[k] = latest[new_label[k]]
        latest[new_label[k]] = k
    return result


@kernel("f1 i1 i1 i1 i1 i")
def node_blocks(
    flat: FloatArray, start: IntArray, size: IntArray, offset: IntArray, rows: IntArray, d: int
) -> FloatArray:
    """(k, d, d) covariances of the nodes `rows` (k,), whose states have size d."""
    result = np.empty((len(rows), d, d))
    for k in range(len(rows)):
        i = rows[k]
        s = size[i]
        at = start[i] + s * offset[i] + offset[i]
        for a in range(d):
            for b in range(d):
                result[k, a, b] = flat[at + a * s + b]
    return result


@kernel("f1 f1 i1 i1 i1 i1 i1 i2")
def planar_marginals(
    mean: FloatArray,
    flat: FloatArray,
    offsets: IntArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    rows: IntArray,
    at: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities (k, 4) of the nodes `rows` (k,) with their covariances (k, 4, 4).

    at (k, 4): where x, y, vx, vy are in the state, -1 for none: then zeros; offsets (n,) of the states in `mean`
    """
    k = len(rows)
    mean_of, covariance = np.zeros((k, 4)), np.zeros((k, 4, 4))
    for r in range(k):
        i = rows[r]
        corner = start[i] + size[i] * offset[i] + offset[i]
        for a in range(4):
            p = at[r, a]
            if p < 0:
                continue
            mean_of[r, a] = mean[offsets[i] + p]
            for b in range(4):
                q = at[r, b]
                if q >= 0:
                    covariance[r, a, b] = flat[corner + p * size[i] + q]
    return mean_of, covariance


@kernel("f1 i1 i1 i1 i1 i1 f")
def uncorrelated_labels(
    flat: FloatArray,
    label: IntArray,
    start: IntArray,
    size: IntArray,
    offset: IntArray,
    dims: IntArray,
    tolerance: float,
) -> IntArray:
    """(n,) components that no correlation above `tolerance` ties, numbered from 0 in the order of their nodes."""
    n = len(label)
    root = np.empty(n, dtype=np.int64)
    count = 0
    for i in range(n):
        root[i], count = i, max(count, label[i] + 1)
    latest, before = np.full(count, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    for i in range(n):
        s, d = size[i], dims[i]
        j = latest[label[i]]
        before[i], latest[label[i]] = j, i
        while j >= 0:
            one, other = i, j
            while root[one] != one:
                root[one] = root[root[one]]
                one = root[one]
            while root[other] != other:
                root[other] = root[root[other]]
                other = root[other]
            if one != other:
                tied = False
                for a in range(d):
                    p = offset[i] + a
                    limit = tolerance * math.sqrt(flat[start[i] + s * p + p])
                    for b in range(dims[j]):
                        q = offset[j] + b
                        bound = limit * math.sqrt(flat[start[i] + s * q + q])
                        if abs(flat[start[i] + s * p + q]) > bound:
                            tied = True
                            break
                    if tied:
                        break
                if tied:
                    root[max(one, other)] = min(one, other)
            j = before[j]
    number = np.empty(n, dtype=np.int64)
    parts = 0
    for i in range(n):
        one = i
        while root[one] != one:
            one = root[one]
        if one == i:
            number[i] = parts
            parts += 1
        else:
            number[i] = number[one]
    return number
