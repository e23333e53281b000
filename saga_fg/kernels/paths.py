"""Predicted paths: along trails and courses, turn rates, and places on them."""

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, FloatArray, IntArray, kernel, kernel_part


@kernel_part
def unwrapped(points: FloatArray, p: int, angle: FloatArray) -> None:
    """Directions of the pieces of path `p`, rad, into `angle` (m,), without jumps."""
    before = 0.0
    for s in range(len(angle)):
        raw = math.atan2(points[p, s + 1, 1] - points[p, s, 1], points[p, s + 1, 0] - points[p, s, 0])
        angle[s] = raw if s == 0 else angle[s - 1] + (raw - before + math.pi) % (2 * math.pi) - math.pi
        before = raw


@kernel("f3 f f f")
def path_cones(
    points: FloatArray, most: float, sharp: float, rounding: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Direction (k,) at the start of paths through points (k, m + 1, 2), how far they turn, and a margin (k,), m."""
    k, m = len(points), points.shape[1] - 1
    begin, turn, margin, angle = np.empty(k), np.empty(k), np.empty(k), np.empty(m)
    for p in range(k):
        unwrapped(points, p, angle)
        farthest, corner = 0.0, 0.0
        for s in range(1, m):
            farthest = max(farthest, abs(angle[s] - angle[0]))
            corner = max(corner, abs(angle[s] - angle[s - 1]))
        begin[p], turn[p], margin[p] = angle[0], farthest, rounding * most / math.cos(min(corner, sharp))
    return begin, turn, margin


@kernel("f2 f1 i1 f3 i1 i1")
def places_along(
    position: FloatArray, heading: FloatArray, path: IntArray, points: FloatArray, target: IntArray, source: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Where nodes `source` (E,) are on the paths of nodes `target` (E,): ahead and aside, m, direction there, rad, and
    whether the path is a predicted one (E,).

    Of n nodes: position (n, 2), heading (n,), path (n,), -1: straight on; of k paths: points (k, m + 1, 2)
    """
    E, m, known = len(target), points.shape[1] - 1, -1
    ahead, aside, direction = np.empty(E), np.empty(E), np.empty(E)
    predicted, angle, middle = np.zeros(E, dtype=np.bool_), np.empty(m), np.empty(m)
    for e in range(E):
        i, j = target[e], source[e]
        p = path[i]
        if p < 0:
            c, s = math.cos(heading[i]), math.sin(heading[i])
            dx, dy = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            ahead[e], aside[e], direction[e] = dx * c + dy * s, dy * c - dx * s, heading[i]
            continue
        if p != known:
            known = p
            unwrapped(points, p, angle)
        least, reached, x, y, before, at, off = math.inf, 0.0, position[j, 0], position[j, 1], 0.0, 0.0, 0.0
        for s in range(m):
            tx, ty = points[p, s + 1, 0] - points[p, s, 0], points[p, s + 1, 1] - points[p, s, 1]
            length = math.sqrt(tx * tx + ty * ty)
            tx, ty = tx / length, ty / length
            dx, dy = x - points[p, s, 0], y - points[p, s, 1]
            along = dx * tx + dy * ty
            if s > 0:
                along = max(along, 0.0)
            if s < m - 1:
                along = min(along, length)
            dx, dy = dx - along * tx, dy - along * ty
            if dx * dx + dy * dy < least:
                least, at, off = dx * dx + dy * dy, before + along, tx * dy - ty * dx
            middle[s] = before + length / 2
            before += length
        reached, a = min(max(at, 0.0), before), -1
        while a + 1 < m and middle[a + 1] <= reached:
            a += 1
        b = min(a + 1, m - 1)
        a = max(a, 0)
        course = angle[a]
        if middle[b] > middle[a]:
            course += (at - middle[a]) / (middle[b] - middle[a]) * (angle[b] - angle[a])
        ahead[e], aside[e], direction[e] = at, off, math.atan2(math.sin(course), math.cos(course))
        predicted[e] = True
    return ahead, aside, direction, predicted


Paths = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("f2 f")
def points_by_cell(points: FloatArray, size: float) -> tuple[IntArray, IntArray]:
    """Points (n, 2) in lists, by the hash of their cells of `size` m.

    (n, 3) for each point its cell and the one before it in its list, -1 for none; the last point of each list
    """
    n, buckets = len(points), 16
    while buckets < 2 * n:
        buckets *= 2
    cells, latest = np.empty((n, 3), dtype=np.int64), np.full(buckets, -1, dtype=np.int64)
    for p in range(n):
        ix, iy = math.floor(points[p, 0] / size), math.floor(points[p, 1] / size)
        bucket = (ix * 73856093 + iy * 19349663) % buckets
        cells[p, 0], cells[p, 1], cells[p, 2] = ix, iy, latest[bucket]
        latest[bucket] = p
    return cells, latest


@kernel("i1 f2 f1 f1 b1 i2 i1 i1 f2 f1 f1 b1 i2 i1 i1 f2 f1 f1 f2 i i f f f f f f")
def trail_paths(
    lane_of: IntArray,
    lane_points: FloatArray,
    lane_headings: FloatArray,
    lane_speeds: FloatArray,
    lane_timed: BoolArray,
    lane_cells: IntArray,
    lane_latest: IntArray,
    trail_of: IntArray,
    trail_points: FloatArray,
    trail_headings: FloatArray,
    trail_speeds: FloatArray,
    trail_timed: BoolArray,
    trail_cells: IntArray,
    trail_latest: IntArray,
    ids: IntArray,
    position: FloatArray,
    heading: FloatArray,
    curvature: FloatArray,
    sharpest: FloatArray,
    steps: int,
    most: int,
    reach: float,
    length: float,
    bend: float,
    turning: float,
    prior: float,
    agreement: float,
) -> Paths:
    """Places (k, steps + 1, 2), courses, typical speeds and weights (k, steps + 1), certainty and disagreement (k,).

    Of n points of lanes, and of those of trails: their tracks `of` (n,), places (n, 2), headings, speeds and whether
    these are known (n,), and the result of `points_by_cell` at 2 * reach; of k tracks: ids (k,), position (k, 2),
    heading, curvature (k,), sharpest (k, 2), the largest turns, rad, at once and within a step; most: points compared;
    length of a step; the rest are the module's scales
    """
    of, points, headings = (lane_of, trail_of), (lane_points, trail_points), (lane_headings, trail_headings)
    speeds, timed = (lane_speeds, trail_speeds), (lane_timed, trail_timed)
    cells, latest = (lane_cells, trail_cells), (lane_latest, trail_latest)
    k, cell = len(ids), 2 * reach
    place, course = np.empty((k, steps + 1, 2)), np.empty((k, steps + 1))
    speed, weight = np.zeros((k, steps + 1)), np.zeros((k, steps + 1))
    certainty, disagreement = np.zeros(k), np.zeros(k)
    near, side, apart = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty(most)
    share, turns = np.empty(most), np.empty(most)
    for t in range(k):
        x, y, h = position[t, 0], position[t, 1], heading[t]
        for step in range(steps + 1):
            own, at_x, at_y = 0.0, x, y
            if step > 0:
                own = curvature[t] * length * math.exp(-(step - 0.5) * length / bend)
                at_x, at_y = x + length * math.cos(h + own / 2), y + length * math.sin(h + own / 2)
            found = 0
            cx, cy = math.floor(at_x / cell), math.floor(at_y / cell)
            for jx in range(cx - 1, cx + 2):
                for jy in range(cy - 1, cy + 2):
                    for s in range(2):
                        p = latest[s][(jx * 73856093 + jy * 19349663) % len(latest[s])]
                        while p >= 0:
                            if cells[s][p, 0] == jx and cells[s][p, 1] == jy:
                                d = math.sqrt((points[s][p, 0] - at_x) ** 2 + (points[s][p, 1] - at_y) ** 2)
                                if d < cell and (found < most or d < apart[found - 1]):
                                    q = min(found, most - 1)
                                    while q > 0 and apart[q - 1] > d:
                                        apart[q], near[q], side[q] = apart[q - 1], near[q - 1], side[q - 1]
                                        q -= 1
                                    apart[q], near[q], side[q] = d, p, s
                                    found = min(found + 1, most)
                            p = cells[s][p, 2]
            total, mean, typical, known = 0.0, 0.0, 0.0, 0.0
            for q in range(found):
                p, s = near[q], side[q]
                share[q] = 0.0
                counts = of[s][p] != ids[t]
                for r in range(q):  # of each trail the nearest point
                    counts = counts and of[side[r]][near[r]] != of[s][p]
                turns[q] = (headings[s][p] - h - own + math.pi) % (2 * math.pi) - math.pi
                if counts:
                    share[q] = math.exp(-((apart[q] / reach) ** 2 + (turns[q] / turning) ** 2) / 2)
                    total += share[q]
                    if timed[s][p]:
                        known += share[q]
                        typical += share[q] * speeds[s][p]
            scale = max(total, 1e-9)
            for q in range(found):
                mean += share[q] / scale * turns[q]
            variance = 0.0
            for q in range(found):
                variance += share[q] / scale * (turns[q] - mean) ** 2
            sure = total / (total + prior) / (1 + variance / agreement**2)
            largest = sharpest[t, min(step, 1)]
            after = h + min(max(own + sure * mean, -largest), largest)
            if step == 0:
                certainty[t], disagreement[t] = sure, variance
            else:
                x, y = x + length * math.cos((h + after) / 2), y + length * math.sin((h + after) / 2)
            h = after
            place[t, step, 0], place[t, step, 1], course[t, step] = x, y, h
            speed[t, step], weight[t, step] = typical / max(known, 1e-9), known
    return place, course, speed, weight, certainty, disagreement


@kernel("f3 i1 f f")
def path_meetings(points: FloatArray, reach: IntArray, near: float, spacing: float) -> tuple[IntArray, IntArray]:
    """Pairs (E, 2) of paths that come within `near` m of one another, and the points (E, 2) of both where they do.

    Of k paths: points (k, m, 2), at most `spacing` m apart, of which the first `reach` (k,) count. It is the first such
    point of the first path, and the point of the second one that is nearest to it.
    """
    k = len(points)
    most = k * (k - 1) // 2
    pair, place, found = np.empty((most, 2), dtype=np.int64), np.empty((most, 2), dtype=np.int64), 0
    for p in range(k):
        for q in range(p + 1, k):
            a, least = 0, math.inf
            while a < reach[p] and least >= near:
                b, least, nearest = 0, math.inf, 0
                while b < reach[q]:
                    d = math.hypot(points[p, a, 0] - points[q, b, 0], points[p, a, 1] - points[q, b, 1])
                    if d < least:
                        least, nearest = d, b
                    b += max(1, int((d - least) / spacing))  # points that are farther than the nearest one
                if least < near:
                    pair[found, 0], pair[found, 1], place[found, 0], place[found, 1] = p, q, a, nearest
                    found += 1
                a += max(1, int((least - near) / spacing))
    return pair[:found], place[:found]


Turning = tuple[FloatArray, FloatArray, FloatArray]


@kernel("f1 f1 f3 f f1 f f")
def predicted_turning(
    heading: FloatArray,
    rate: FloatArray,
    P: FloatArray,
    dt: float,
    fading_time: FloatArray,
    deviation: float,
    least_time: float,
) -> Turning:
    """Headings, rates (n,) and covariances (n, 2, 2) after `dt` s."""
    n, variance = len(rate), deviation**2
    headings, rates, covariance = np.empty(n), np.empty(n), np.empty((n, 2, 2))
    for k in range(n):
        tau = max(fading_time[k], least_time)
        kept = math.exp(-dt / tau)
        turned = tau * (1 - kept)
        angle = (heading[k] + turned * rate[k] + math.pi) % (2 * math.pi) - math.pi
        headings[k] = -math.pi if angle >= math.pi else angle
        rates[k] = kept * rate[k]
        p, q, r, s = P[k, 0, 0], P[k, 0, 1], P[k, 1, 0], P[k, 1, 1]
        covariance[k, 0, 0] = p + turned * r + (q + turned * s) * turned
        covariance[k, 0, 0] += variance * tau * (2 * dt - tau * (3 - 4 * kept + kept**2))
        both = variance * turned * (1 - kept)
        covariance[k, 0, 1], covariance[k, 1, 0] = (q + turned * s) * kept + both, kept * (r + s * turned) + both
        covariance[k, 1, 1] = kept * s * kept + variance * (1 - kept**2)
    return headings, rates, covariance


@kernel("f1 f1 f3 i1 f1 f1 f")
def updated_turning(
    heading: FloatArray,
    rate: FloatArray,
    P: FloatArray,
    rows: IntArray,
    yaw: FloatArray,
    yaw_noise: FloatArray,
    outlier: float,
) -> Turning:
    """Headings, rates (k,) and covariances (k, 2, 2) of the tracks `rows` (k,) after headings `yaw` (k,), NaN: none."""
    k = len(rows)
    headings, rates, covariance = np.empty(k), np.empty(k), np.empty((k, 2, 2))
    for e in range(k):
        i = rows[e]
        h, p, q, r, s = heading[i], P[i, 0, 0], P[i, 0, 1], P[i, 1, 0], P[i, 1, 1]
        headings[e], rates[e] = h, rate[i]
        covariance[e, 0, 0], covariance[e, 0, 1], covariance[e, 1, 0], covariance[e, 1, 1] = p, q, r, s
        if not math.isfinite(yaw[e]):
            continue
        variance = yaw_noise[e] ** 2
        if not math.isfinite(h):
            headings[e] = yaw[e]
            covariance[e, 0, 0], covariance[e, 0, 1], covariance[e, 1, 0] = variance, 0.0, 0.0
            continue
        twice = (2 * (yaw[e] - h) + math.pi) % (2 * math.pi) - math.pi
        innovation = (-math.pi if twice >= math.pi else twice) / 2
        S = max(p + variance, (innovation / outlier) ** 2)
        g, w = p / S, r / S
        angle = (h + g * innovation + math.pi) % (2 * math.pi) - math.pi
        headings[e] = -math.pi if angle >= math.pi else angle
        rates[e] = rate[i] + w * innovation
        covariance[e, 0, 0], covariance[e, 0, 1] = p - g * p, q - g * q
        covariance[e, 1, 0], covariance[e, 1, 1] = r - w * p, s - w * q
    return headings, rates, covariance


@kernel("f1 f3 i1 f f f")
def known_turning(
    rate: FloatArray, P: FloatArray, rows: IntArray, share: float, turning: float, straight: float
) -> tuple[FloatArray, FloatArray]:
    """Rates (k,) of tracks `rows` (k,) to predict with, and their variances (k,)."""
    known, variances = np.empty(len(rows)), np.empty(len(rows))
    for e in range(len(rows)):
        w, p = rate[rows[e]], P[rows[e], 1, 1]
        one, other = p + straight**2, p + turning**2
        log_odds = math.log(share / (1 - share)) + 0.5 * math.log(one / other)
        odds = min(max(-log_odds - 0.5 * w**2 * (1 / one - 1 / other), -50.0), 50.0)
        turns = 1 / (1 + math.exp(odds))
        if_turning, if_straight = turning**2 / other, straight**2 / one
        kept = turns * if_turning + (1 - turns) * if_straight
        known[e] = w * kept
        variances[e] = p * kept + turns * (1 - turns) * (w * (if_turning - if_straight)) ** 2
    return known, variances


@kernel("f1 f1 f1 f2 f1 f1 f1 f f f3 f3")
def course_motions(
    heading: FloatArray,
    theta: FloatArray,
    lateral_noise: FloatArray,
    brake: FloatArray,
    settling: FloatArray,
    pull: FloatArray,
    scale: FloatArray,
    dt: float,
    least: float,
    F_axis: FloatArray,
    Q_axis: FloatArray,
) -> Turning:
    """F (n, 6, 6), b (n, 6), Q (n, 6, 6) of motions that turn by `theta` (n,), rad.

    F_axis, Q_axis (3, 3, 3): of one axis, along and across the heading, and across it of white noise of density 1
    """
    n = len(heading)
    F, b, Q = np.empty((n, 6, 6)), np.zeros((n, 6)), np.empty((n, 6, 6))
    ahead, aside = np.empty((2, 2)), np.empty((2, 2))
    turn, chord, faded = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    row, fades = np.empty((2, 7)), False
    for k in range(n):
        fades = fades or settling[k] > 0
    for k in range(n):
        u = math.cos(heading[k]), math.sin(heading[k])
        for p in range(2):
            for q in range(2):
                ahead[p, q] = u[p] * u[q]
                aside[p, q] = (1.0 if p == q else 0.0) - u[p] * u[q]
        for i in range(3):
            for j in range(3):
                noise = Q_axis[1, i, j] + lateral_noise[k] * Q_axis[2, i, j]
                for p in range(2):
                    for q in range(2):
                        F[k, 2 * i + p, 2 * j + q] = F_axis[0, i, j] * ahead[p, q] + F_axis[1, i, j] * aside[p, q]
                        Q[k, 2 * i + p, 2 * j + q] = scale[k] * (Q_axis[0, i, j] * ahead[p, q] + noise * aside[p, q])
        for i in range(6):
            b[k, i] = -(F[k, i, 4] * brake[k, 0] + F[k, i, 5] * brake[k, 1])
        for p in range(2):
            b[k, p] += dt * dt / 2 * (pull[k] * u[p])
            b[k, 2 + p] += dt * (pull[k] * u[p])
        half = theta[k] / 2
        share = math.sin(half) / half if half != 0 else 1.0
        c, s = math.cos(half), math.sin(half)
        chord[0, 0], chord[0, 1], chord[1, 0], chord[1, 1] = share * c, -share * s, share * s, share * c
        c, s = math.cos(theta[k]), math.sin(theta[k])
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = c, -s, s, c
        if fades:
            passed = max(settling[k] * dt, least)
            lost = -math.expm1(-passed)
            for which in range(2):
                angle = heading[k] + (half if which == 0 else theta[k]) + math.pi / 2
                less = 1 - lost / passed if which == 0 else lost
                x, y = math.cos(angle), math.sin(angle)
                m = chord if which == 0 else turn
                for q in range(2):
                    along = x * m[0, q] + y * m[1, q]
                    faded[0, q], faded[1, q] = m[0, q] - less * x * along, m[1, q] - less * y * along
                for p in range(2):
                    for q in range(2):
                        m[p, q] = faded[p, q]
        for part in range(3):
            m, first = (chord, 2) if part == 0 else (turn, 0)
            for p in range(2):
                for j in range(6):
                    row[p, j] = m[p, 0] * F[k, 2 * part, j] + m[p, 1] * F[k, 2 * part + 1, j]
                row[p, 6] = m[p, 0] * b[k, 2 * part] + m[p, 1] * b[k, 2 * part + 1]
            for p in range(2):
                for j in range(first, 6):
                    F[k, 2 * part + p, j] = row[p, j]
                b[k, 2 * part + p] = row[p, 6]
    return F, b, Q


@kernel("f1 f1 f2 f3 f f")
def mean_courses(
    yaw: FloatArray, variance: FloatArray, velocity: FloatArray, P: FloatArray, astray: float, least: float
) -> FloatArray:
    """Means (k,) of headings (k,), rad, with their variances, and the directions of velocities (k, 2) with covariances
    P (k, 2, 2), by information, where they differ by less than `astray`."""
    result = yaw.copy()
    for k in range(len(yaw)):
        x, y = velocity[k, 0], velocity[k, 1]
        square = max(x * x + y * y, least)
        off = (math.atan2(y, x) - yaw[k] + math.pi) % (2 * math.pi) - math.pi
        if abs(off) < astray:
            across = y * y * P[k, 0, 0] - x * y * (P[k, 0, 1] + P[k, 1, 0]) + x * x * P[k, 1, 1]
            result[k] += variance[k] / (variance[k] + across / square**2) * off
    return result


@kernel("f1 f1 f2 f1 f1 f f")
def course_inputs(
    heading: FloatArray,
    rate_variance: FloatArray,
    mean: FloatArray,
    settling: FloatArray,
    across: FloatArray,
    dt: float,
    correlation: float,
) -> tuple[FloatArray, FloatArray]:
    """Lateral noise (n,) and accelerations that are taken away (n, 2), of states `mean` (n, 6), see
    `saga_fg.model.manoeuvres`."""
    n = len(heading)
    noise, brake = np.empty(n), np.zeros((n, 2))
    for k in range(n):
        c, s = math.cos(heading[k]), math.sin(heading[k])
        speed, acceleration = mean[k, 2] * c + mean[k, 3] * s, mean[k, 4] * c + mean[k, 5] * s
        if acceleration < 0 and speed + acceleration * dt < 0:
            brake[k, 0], brake[k, 1] = acceleration * c, acceleration * s
        square = mean[k, 2] ** 2 + mean[k, 3] ** 2
        noise[k] = 2 * (correlation * rate_variance[k] * square + settling[k] * across[k])
    return noise, brake
