"""Components of a joint state: labels, covariance blocks one after the other, and quantities of them.

Components of a joint state whose covariance blocks lie one after the other in one array.

The block of a component of size s begins at its `start`; the covariance of nodes i and j of it, whose states begin at
offset[i] and offset[j], at start + s offset[i] + offset[j], with rows s apart. See `saga_fg.estimators.partition`.
"""

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, CodeArray, FloatArray, IntArray, kernel, kernel_part

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


@kernel_part
def root_of(root: IntArray, node: int) -> int:
    """The root of a node's set; the paths to it are halved on the way."""
    while root[node] != node:
        root[node] = root[root[node]]
        node = root[node]
    return node


@kernel_part
def numbered_sets(root: IntArray) -> IntArray:
    """Numbers (n,) of the sets of nodes, from 0 in the order of their first; no root comes after a node below it."""
    number, sets = np.empty(len(root), dtype=np.int64), 0
    for k in range(len(root)):
        if root[k] == k:
            number[k] = sets
            sets += 1
        else:
            number[k] = number[root[k]]
    return number


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
            one, other = root_of(root, i), root_of(root, j)
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
    return numbered_sets(root)


@kernel("i i1 i1 i1 i")
def united_labels(count: int, nodes: IntArray, a: IntArray, b: IntArray, most: int) -> IntArray:
    """(count,) number of the set that each of `count` sets is in when a[k] and b[k] (k,) are united, pair by pair.

    nodes (count,) of each; those that would come to more than `most` nodes are not united. Numbers are from 0 without
    gaps, in the order of the first of each set.
    """
    root, size = np.arange(count), nodes.copy()
    for k in range(len(a)):
        one, other = root_of(root, a[k]), root_of(root, b[k])
        if one != other and size[one] + size[other] <= most:
            first, second = min(one, other), max(one, other)
            root[second], size[first] = first, size[one] + size[other]
    return numbered_sets(root)


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


@kernel("f3 f1 f1 f1")
def biased_covariances(P: FloatArray, yaw: FloatArray, scale: FloatArray, bias: FloatArray) -> FloatArray:
    """Reported covariances (n, 2, 2), m^2, of positions: scale^2 P + bias^2 u u^T, u the direction of the heading.

    P (n, 2, 2), yaw (n,), scale (n,) on the deviations, bias (n,) its deviation, m. Where the heading is unknown, half
    of the variance of the bias goes to each axis.
    """
    n = len(yaw)
    result = np.empty((n, 2, 2))
    for k in range(n):
        xx, xy, yy = 0.5, 0.0, 0.5
        if math.isfinite(yaw[k]):
            c, s = math.cos(yaw[k]), math.sin(yaw[k])
            xx, xy, yy = c * c, c * s, s * s
        by_scale, by_bias = scale[k] ** 2, bias[k] ** 2
        result[k, 0, 0], result[k, 0, 1] = by_scale * P[k, 0, 0] + by_bias * xx, by_scale * P[k, 0, 1] + by_bias * xy
        result[k, 1, 0], result[k, 1, 1] = by_scale * P[k, 1, 0] + by_bias * xy, by_scale * P[k, 1, 1] + by_bias * yy
    return result


@kernel("f1 f1 f1 f1 f1")
def velocities_along(
    yaw: FloatArray, speed: FloatArray, variance: FloatArray, isotropic: FloatArray, lateral: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Velocities (k, 2) of a `speed` (k,) ahead with its variance (k,), and their covariances (k, 2, 2).

    Deviations (k,): `lateral` across a known yaw (k,), `isotropic` where it is NaN, of a velocity that is 0 in the mean
    """
    k = len(yaw)
    velocity, P = np.zeros((k, 2)), np.zeros((k, 2, 2))
    for t in range(k):
        P[t, 0, 0] = P[t, 1, 1] = isotropic[t] ** 2
        if math.isfinite(yaw[t]):
            c, s, across = math.cos(yaw[t]), math.sin(yaw[t]), lateral[t] ** 2
            along = variance[t] - across
            velocity[t, 0], velocity[t, 1] = speed[t] * c, speed[t] * s
            P[t, 0, 0], P[t, 1, 1] = across + along * (c * c), across + along * (s * s)
            P[t, 0, 1] = P[t, 1, 0] = along * (c * s)
    return velocity, P


@kernel("f1 b1 f2 f3")
def speeds_ahead(
    yaw: FloatArray, moves: BoolArray, velocity: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Headings (n,), that of the velocity (n, 2) where the yaw (n,) of one that moves is NaN; speeds along them (n,)
    and their variances (n,), of velocities with covariances P (n, 2, 2)."""
    n = len(yaw)
    heading, speed, variance = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        h = yaw[k]
        if moves[k] and not math.isfinite(h):
            h = math.atan2(velocity[k, 1], velocity[k, 0])
        c, s = math.cos(h), math.sin(h)
        heading[k], speed[k] = h, c * velocity[k, 0] + s * velocity[k, 1]
        variance[k] = c * c * P[k, 0, 0] + c * s * (P[k, 0, 1] + P[k, 1, 0]) + s * s * P[k, 1, 1]
    return heading, speed, variance
