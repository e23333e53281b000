"""Pairs of tracks and measurements, of tracks and their returns, of boxes: gates, costs, overlap, who hides whom."""

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, FloatArray, IntArray, kernel, kernel_part
from saga_fg.kernels.edges import wrapped

Gated = tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("f2 f2 f1 f1")
def compared_pairs(a: FloatArray, b: FloatArray, reach: FloatArray, further: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows (k,) of places a (n, 2) and b (m, 2) with |a_i - b_j| <= reach_i + further_j, in order of i, then of j."""
    n, m = len(a), len(b)
    k, room = 0, max(64, 2 * (n + m))
    found = np.empty((2, room), dtype=np.int64)
    row, column = found[0], found[1]
    low, high, widest = math.inf, -math.inf, -math.inf
    for j in range(m):
        low, high = min(low, b[j, 0]), max(high, b[j, 0])
        if further[j] > widest:
            widest = further[j]
    width = max((high - low) / max(m, 1), 1e-9)
    first, following = np.full(m, -1, dtype=np.int64), np.empty(m, dtype=np.int64)
    for j in range(m - 1, -1, -1):  # strips of equal width along x
        strip = min(int((b[j, 0] - low) / width), m - 1)
        following[j], first[strip] = first[strip], j
    for i in range(n):
        span, begin = reach[i] + widest, k
        if not span >= 0 or m == 0:
            continue
        start, end = (a[i, 0] - span - low) / width - 1, (a[i, 0] + span - low) / width + 1
        if end < 0 or start >= m:
            continue
        if k + m > room:
            room = 2 * room + m
            longer = np.empty((2, room), dtype=np.int64)
            for e in range(k):
                longer[0, e], longer[1, e] = row[e], column[e]
            row, column = longer[0], longer[1]
        one, last = int(max(start, 0.0)), int(min(end, m - 1.0))
        if (last - one) ** 2 > 4 * m:  # more work to order what is found than to compare all
            for j in range(m):
                x, y, r = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], reach[i] + further[j]
                row[k], column[k] = i, j
                k += x * x + y * y <= r * r
            continue
        for strip in range(one, last + 1):
            j = first[strip]
            while j >= 0:
                x, y, r = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], reach[i] + further[j]
                if x * x + y * y <= r * r:
                    row[k] = i
                    at = k
                    while at > begin and column[at - 1] > j:
                        column[at] = column[at - 1]
                        at -= 1
                    column[at] = j
                    k += 1
                j = following[j]
    return row[:k].copy(), column[:k].copy()


@kernel("i1 i1 f2 f3 f1 i1 f2 f3 i1")
def gated_pairs(
    row: IntArray,
    column: IntArray,
    position: FloatArray,
    P: FloatArray,
    gate: FloatArray,
    group: IntArray,
    z: FloatArray,
    R: FloatArray,
    group_z: IntArray,
) -> Gated:
    """Rows of the tracks and of the measurements (k,) of pairs inside the gates, innovation (k, 2), S (k, 2, 2), d2 and
    cost (k,), as `saga_fg.tracking.association` defines them.

        S = P + R,   d2 = (z - x)^T S^-1 (z - x),   cost = d2 + log det S

    A pair of one class is inside where d2 < gate. Of E pairs within reach: rows `row`, `column` (E,); of n tracks:
    position (n, 2), P (n, 2, 2), gate (n,), group (n,) class; of m measurements: z (m, 2), R (m, 2, 2), group_z (m,)
    """
    k, E = 0, len(row)
    rows, innovation, S, costs = (
        np.empty((2, E), dtype=np.int64),
        np.empty((E, 2)),
        np.empty((E, 2, 2)),
        np.empty((2, E)),
    )
    for e in range(E):
        i, j = row[e], column[e]
        if group[i] != group_z[j]:
            continue
        x, y = z[j, 0] - position[i, 0], z[j, 1] - position[i, 1]
        a, b, c = P[i, 0, 0] + R[j, 0, 0], P[i, 0, 1] + R[j, 0, 1], P[i, 1, 1] + R[j, 1, 1]
        det = a * c - b * b
        d2 = (c * x * x - 2 * b * x * y + a * y * y) / det
        if d2 < gate[i]:
            rows[0, k], rows[1, k], innovation[k, 0], innovation[k, 1] = i, j, x, y
            S[k, 0, 0], S[k, 0, 1], S[k, 1, 0], S[k, 1, 1] = a, b, b, c
            costs[0, k], costs[1, k] = d2, d2 + np.log(det)
            k += 1
    return rows[0, :k], rows[1, :k], innovation[:k], S[:k], costs[0, :k], costs[1, :k]


@kernel("i1 i1 f2 f3 f2 f3 f1 f1 f2 f3 i1 f1 f f")
def relinking_pairs(
    tracks: IntArray,
    group: IntArray,
    position: FloatArray,
    P: FloatArray,
    place: FloatArray,
    D: FloatArray,
    stationary: FloatArray,
    log_survival: FloatArray,
    z: FloatArray,
    R: FloatArray,
    group_z: IntArray,
    log_density: FloatArray,
    least: float,
    rounding: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of `tracks` and measurements (k,) with their costs (k,) < 0, the least log-odds less theirs.

    Of all n tracks: group (n,), N(position, P) if they move, N(place, D) if they are stationary, with the probability
    `stationary` (n,); of m measurements: z (m, 2), R (m, 2, 2), group_z (m,), log_density (m,) of others like them.
    Left out are pairs whose distance neither density reaches, see `saga_fg.tracking.relinking`; rounding: factor on it
    """
    largest = -math.inf
    for j in range(len(z)):
        largest = max(largest, -log_density[j])
    found_t, found_d, costs = [0][:0], [0][:0], [0.0][:0]
    gates = np.empty(2)
    log_2_pi = math.log(2 * math.pi)
    for i in tracks:
        most = log_survival[i] + largest - log_2_pi - least
        for still in range(2):
            C = D if still else P
            det = max(C[i, 0, 0] * C[i, 1, 1] - C[i, 0, 1] * C[i, 0, 1], 1e-300)
            gates[still] = max(2 * most - math.log(det), 0.0) * rounding
        for j in range(len(z)):
            if group[i] != group_z[j]:
                continue
            near = False
            for still in range(2):
                mean, C = (place, D) if still else (position, P)
                x, y = z[j, 0] - mean[i, 0], z[j, 1] - mean[i, 1]
                trace = C[i, 0, 0] + C[i, 1, 1] + R[j, 0, 0] + R[j, 1, 1]
                near = near or x * x + y * y <= gates[still] * trace
            if not near:
                continue
            s = min(max(stationary[i], 0.0), 1 - 1e-9)
            terms = math.log1p(-s), math.log(max(s, 1e-300))
            total = -math.inf
            for still in range(2):
                mean, C = (place, D) if still else (position, P)
                x, y = z[j, 0] - mean[i, 0], z[j, 1] - mean[i, 1]
                a, b, c = C[i, 0, 0] + R[j, 0, 0], C[i, 0, 1] + R[j, 0, 1], C[i, 1, 1] + R[j, 1, 1]
                det = a * c - b * b
                density = -0.5 * ((c * x * x - 2 * b * x * y + a * y * y) / det + np.log(det)) - log_2_pi
                term = density + (terms[1] if still else terms[0])
                high, low = max(total, term), min(total, term)
                total = high if low == -math.inf else high + math.log1p(math.exp(low - high))
            cost = least - (log_survival[i] + total - log_density[j])
            if cost < 0:
                found_t.append(i)
                found_d.append(j)
                costs.append(cost)
    return np.array(found_t), np.array(found_d), np.array(costs)


@kernel("i1 i1 i1 f1 f1 f2 f3 f2 f3 f")
def returned_pairs(
    new: IntArray,
    old: IntArray,
    group: IntArray,
    initiated: FloatArray,
    last_detected: FloatArray,
    position: FloatArray,
    P: FloatArray,
    place: FloatArray,
    D: FloatArray,
    farthest: float,
) -> tuple[IntArray, IntArray, IntArray]:
    """Rows of pairs of `new` and `old` tracks (e,), and the number (e,) of new ones of the group.

    They share a group, the old one was last detected before the new one's start, and the squared distance of their
    positions, N(position, P), or of their stationary places, N(place, D), is below `farthest`.
    """
    first, second, others = [0][:0], [0][:0], [0][:0]
    for i in new:
        alike = 0
        for j in new:
            alike += group[j] == group[i]
        for j in old:
            if group[j] != group[i] or not last_detected[j] < initiated[i]:
                continue
            for still in range(2):
                mean, covariance = (place, D) if still else (position, P)
                x, y = mean[i, 0] - mean[j, 0], mean[i, 1] - mean[j, 1]
                a = covariance[i, 0, 0] + covariance[j, 0, 0]
                b = covariance[i, 0, 1] + covariance[j, 0, 1]
                c = covariance[i, 1, 1] + covariance[j, 1, 1]
                if (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b) < farthest:
                    first.append(i)
                    second.append(j)
                    others.append(alike)
                    break
    return np.array(first), np.array(second), np.array(others)


@kernel("f2 f3 f2 f3 b1 f3 f1 f1 f1 f2 f3")
def return_evidence(
    mean: FloatArray,
    P: FloatArray,
    old_mean: FloatArray,
    old_P: FloatArray,
    moves: BoolArray,
    V: FloatArray,
    p: FloatArray,
    s: FloatArray,
    old_s: FloatArray,
    apart: FloatArray,
    D: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Logs of `moving` and `stationary` (e,), as `saga_fg.tracking.relinking` defines them.

    mean (e, 4), P (e, 4, 4): position and velocity of the new tracks, and old_... of the old ones; moves (e,): whether
    the state has a velocity; V (e, 2, 2) its prior; p, s, old_s (e,) probabilities of being stationary; apart (e, 2), D
    (e, 2, 2) of the stationary places
    """
    e = len(p)
    moving, still = np.empty(e), np.empty(e)
    log_2_pi = math.log(2 * math.pi)
    g = np.empty((2, 2))
    S = np.empty((4, 4))
    x = np.empty(4)
    for k in range(e):
        for i in range(4):
            x[i] = mean[k, i] - old_mean[k, i]
            for j in range(4):
                S[i, j] = P[k, i, j] + old_P[k, i, j]
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        d2 = (S[1, 1] * x[0] * x[0] - 2 * S[0, 1] * x[0] * x[1] + S[0, 0] * x[1] * x[1]) / det
        total = -0.5 * (d2 + math.log(det) + 2 * log_2_pi)
        if moves[k]:
            for i in range(2):  # the velocity given the position
                u, v = S[0, 2 + i], S[1, 2 + i]
                g[i, 0], g[i, 1] = (S[1, 1] * u - S[0, 1] * v) / det, (S[0, 0] * v - S[0, 1] * u) / det
                x[2 + i] -= g[i, 0] * x[0] + g[i, 1] * x[1]
            a = S[2, 2] - g[0, 0] * S[0, 2] - g[0, 1] * S[1, 2]
            b = S[2, 3] - g[0, 0] * S[0, 3] - g[0, 1] * S[1, 3]
            c = S[3, 3] - g[1, 0] * S[0, 3] - g[1, 1] * S[1, 3]
            det = a * c - b * b
            d2 = (c * x[2] * x[2] - 2 * b * x[2] * x[3] + a * x[3] * x[3]) / det
            prior = math.log(V[k, 0, 0] * V[k, 1, 1] - V[k, 0, 1] * V[k, 0, 1])
            total += 0.5 * (prior - d2 - math.log(det))
        prior_p = min(max(p[k], 1e-9), 1 - 1e-9)
        one, other = min(max(s[k], 0.0), 1 - 1e-9), min(max(old_s[k], 0.0), 1 - 1e-9)
        moving[k] = math.log1p(-one) + math.log1p(-other) - math.log1p(-prior_p) + total
        a, b, c = D[k, 0, 0], D[k, 0, 1], D[k, 1, 1]
        det = a * c - b * b
        u, v = apart[k, 0], apart[k, 1]
        density = -0.5 * ((c * u * u - 2 * b * u * v + a * v * v) / det + math.log(det) + 2 * log_2_pi)
        still[k] = np.log(one) + np.log(other) - math.log(prior_p) + density
    return moving, still


@kernel("f2 f2 f1 f2 f2 f1 f")
def paired_overlaps(
    position: FloatArray,
    size: FloatArray,
    yaw: FloatArray,
    other_position: FloatArray,
    other_size: FloatArray,
    other_yaw: FloatArray,
    hair: float,
) -> FloatArray:
    """(n,) area common to the footprints of n boxes and n others, m^2; NaN where a size or heading is unknown.

    hair: relative growth and shrinkage, so that common edges count once
    """
    n = len(yaw)
    result = np.zeros(n)
    signs_x, signs_y = (1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0)
    x, y, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for i in range(n):
        hx, hy, gx, gy = size[i, 0] / 2, size[i, 1] / 2, other_size[i, 0] / 2, other_size[i, 1] / 2
        ox, oy = position[i, 0] - other_position[i, 0], position[i, 1] - other_position[i, 1]
        if math.isnan(hx + hy + gx + gy + yaw[i] + other_yaw[i]):
            result[i] = np.nan
            continue
        grown = hair * max(hx + hy, gx + gy)
        total = 0.0
        for turn in range(2):  # edges of the first in the frame of the second, and the other way round
            if turn == 0:
                ax, ay, bx, by, px, py = hx, hy, gx + grown, gy + grown, ox, oy
                own, frame = yaw[i], other_yaw[i]
            else:
                ax, ay, bx, by, px, py = gx, gy, hx - grown, hy - grown, -ox, -oy
                own, frame = other_yaw[i], yaw[i]
            c, s = math.cos(frame), math.sin(frame)
            mx, my = c * px + s * py, c * py - s * px
            c, s = math.cos(own - frame), math.sin(own - frame)
            for k in range(4):
                kx, ky = ax * signs_x[k], ay * signs_y[k]
                x[k], y[k] = mx + (c * kx - s * ky), my + (s * kx + c * ky)
            for k in range(4):
                dx[k], dy[k] = x[(k + 1) % 4] - x[k], y[(k + 1) % 4] - y[k]
            for k in range(4):
                run_x = 1e-300 if abs(dx[k]) < 1e-300 else dx[k]
                run_y = 1e-300 if abs(dy[k]) < 1e-300 else dy[k]
                x1, x2 = (-bx - x[k]) / run_x, (bx - x[k]) / run_x
                y1, y2 = (-by - y[k]) / run_y, (by - y[k]) / run_y
                enter = max(max(min(x1, x2), min(y1, y2)), 0.0)
                leave = min(min(max(x1, x2), max(y1, y2)), 1.0)
                share = max(leave - enter, 0.0)
                total += share * (x[k] * dy[k] - y[k] * dx[k]) if turn == 0 else share * 2 * gx * gy
        result[i] = min(max(total / 2, 0.0), min(4 * hx * hy, 4 * gx * gy))
    return result


@kernel_part
def _crossed(angle: float, x: float, y: float, yaw: float, size: FloatArray) -> tuple[float, float]:
    """Ranges at which a ray from the origin enters and leaves the footprint of a box at x, y; inf where it misses."""
    c, s = math.cos(yaw), math.sin(yaw)
    own_x, own_y = -(c * x + s * y), s * x - c * y
    dx, dy = math.cos(angle - yaw), math.sin(angle - yaw)
    dx, dy = 1e-12 if abs(dx) < 1e-12 else dx, 1e-12 if abs(dy) < 1e-12 else dy
    x1, x2 = (-size[0] / 2 - own_x) / dx, (size[0] / 2 - own_x) / dx
    y1, y2 = (-size[1] / 2 - own_y) / dy, (size[1] / 2 - own_y) / dy
    enters, leaves = max(min(x1, x2), min(y1, y2)), min(max(x1, x2), max(y1, y2))
    if enters <= leaves and leaves > 0:
        return max(enters, 0.0), leaves
    return math.inf, math.inf


@kernel("f1 f2 f1 f2 i1 b1 b i")
def visible_shares(
    viewpoint: FloatArray,
    position: FloatArray,
    yaw: FloatArray,
    size: FloatArray,
    targets: IntArray,
    solid: BoolArray,
    estimated: bool,
    rays: int,
) -> FloatArray:
    """(k,) share of the boxes `targets` (k,) of n that are visible from a point, see `saga_fg.tracking.update`.

    solid (n,) can hide others; estimated: none hides what it overlaps; 1 where a size or heading is unknown
    """
    n, k = len(yaw), len(targets)
    x, y, bearing, low, high = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    nearest, farthest, known = np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
    for i in range(n):
        x[i], y[i] = position[i, 0] - viewpoint[0], position[i, 1] - viewpoint[1]
        known[i] = math.isfinite(x[i] + y[i] + yaw[i] + size[i, 0] + size[i, 1] + size[i, 2])
        bearing[i], low[i], high[i], farthest[i] = math.atan2(y[i], x[i]), math.inf, -math.inf, 0.0
        nearest[i] = math.hypot(x[i], y[i]) - math.hypot(size[i, 0], size[i, 1]) / 2
        c, s = math.cos(yaw[i]), math.sin(yaw[i])
        for corner in range(4):
            hx = size[i, 0] / 2 if corner % 2 else -size[i, 0] / 2
            hy = size[i, 1] / 2 if corner // 2 else -size[i, 1] / 2
            cx, cy = x[i] + c * hx - s * hy, y[i] + s * hx + c * hy
            spread = wrapped(math.atan2(cy, cx) - bearing[i])
            low[i], high[i] = min(low[i], spread), max(high[i], spread)
            farthest[i] = max(farthest[i], math.hypot(cx, cy))
    result = np.ones(k)
    angle, own, highest = np.empty(rays), np.empty(rays), np.empty(rays)
    for j in range(k):
        t = targets[j]
        if not known[t]:
            continue
        for ray in range(rays):
            angle[ray] = bearing[t] + low[t] + (ray + 0.5) / rays * (high[t] - low[t])
            own[ray], _ = _crossed(angle[ray], x[t], y[t], yaw[t], size[t])
            if math.isinf(own[ray]):
                own[ray] = math.hypot(x[t], y[t])
            highest[ray] = 0.0
        for i in range(n):
            if i == t or not (solid[i] and known[i]) or nearest[i] >= farthest[t]:
                continue
            between = wrapped(bearing[i] - bearing[t])
            beside = nearest[i] < 0.5  # m: it may fill more than half the circle
            if not beside and (between + low[i] >= high[t] or between + high[i] <= low[t]):
                continue
            rise = size[i, 2] - viewpoint[2]
            for ray in range(rays):
                enters, leaves = _crossed(angle[ray], x[i], y[i], yaw[i], size[i])
                if not math.isinf(enters) and (leaves <= own[ray] if estimated else enters < own[ray]):
                    rim = max(leaves if rise < 0 else enters, 0.1)
                    highest[ray] = max(highest[ray], viewpoint[2] + rise * own[ray] / rim)
        shown = 0.0
        for ray in range(rays):
            shown += min(max((size[t, 2] - highest[ray]) / size[t, 2], 0.0), 1.0)
        result[j] = shown / rays
    return result
