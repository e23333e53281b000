"""What is estimated track by track: boxes, stationarity, first speeds, going on, and probabilities of associations."""

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, FloatArray, IntArray, kernel, kernel_part
from saga_fg.kernels.components import root_of

Shapes = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@kernel("f2 f1 f1 f1 f1 f1 f1 i1 f2 f1 f1 f1 f1 f1 f f")
def updated_boxes(
    size: FloatArray,
    size_weight: FloatArray,
    z: FloatArray,
    z_variance: FloatArray,
    yaw: FloatArray,
    yaw_variance: FloatArray,
    votes: FloatArray,
    rows: IntArray,
    seen_size: FloatArray,
    weight: FloatArray,
    seen_z: FloatArray,
    z_noise: FloatArray,
    seen_yaw: FloatArray,
    yaw_noise: FloatArray,
    most_weight: float,
    most_votes: float,
) -> Shapes:
    """Sizes (k, 3), their weights, heights, headings with their variances, votes (k,) of the tracks `rows` (k,)."""
    k = len(rows)
    sizes, others = np.empty((k, 3)), np.empty((6, k))
    for e in range(k):
        i = rows[e]
        total = size_weight[i] + weight[e]
        share = weight[e] / total if total > 0 else 0.0
        known = math.isfinite(seen_size[e, 0]) and math.isfinite(seen_size[e, 1]) and math.isfinite(seen_size[e, 2])
        for p in range(3):
            old = size[i, p] if math.isfinite(size[i, p]) else seen_size[e, p]
            sizes[e, p] = old + share * (seen_size[e, p] - old) if known else size[i, p]
        others[0, e] = min(total, most_weight) if known else size_weight[i]
        gain = z_variance[i] / (z_variance[i] + z_noise[e] ** 2)
        others[1, e], others[2, e] = z[i] + gain * (seen_z[e] - z[i]), z_variance[i] * (1 - gain)
        heading, variance, vote = yaw[i], yaw_variance[i], votes[i]
        if math.isfinite(seen_yaw[e]):
            if not math.isfinite(heading):
                heading, variance, gain = seen_yaw[e], yaw_noise[e] ** 2, 0.0
            else:
                gain = variance / (variance + yaw_noise[e] ** 2)
            apart = (seen_yaw[e] - heading + math.pi) % (2 * math.pi) - math.pi
            against = abs(-math.pi if apart >= math.pi else apart) > math.pi / 2
            if against:
                apart = (apart + 2 * math.pi) % (2 * math.pi) - math.pi
            heading = (heading + gain * apart + math.pi) % (2 * math.pi) - math.pi
            variance *= 1 - gain
            vote = min(vote + (-weight[e] if against else weight[e]), most_votes)
        if vote < 0:
            heading, vote = (heading + 2 * math.pi) % (2 * math.pi) - math.pi, -vote
        others[3, e], others[4, e], others[5, e] = -math.pi if heading >= math.pi else heading, variance, vote
    return sizes, others[0], others[1], others[2], others[3], others[4], others[5]


@kernel("f1 f1 f2 f f")
def faced_boxes(
    yaw: FloatArray, votes: FloatArray, velocity: FloatArray, moving: float, most_votes: float
) -> tuple[FloatArray, FloatArray]:
    """Headings and votes (n,) where clear motions, velocity (n, 2), decide on the front."""
    headings, later = np.empty(len(yaw)), np.empty(len(yaw))
    for i in range(len(yaw)):
        along = math.cos(yaw[i]) * velocity[i, 0] + math.sin(yaw[i]) * velocity[i, 1]
        headings[i], later[i] = yaw[i], most_votes if abs(along) > moving else abs(votes[i])
        if along < -moving:
            angle = (yaw[i] + 2 * math.pi) % (2 * math.pi) - math.pi
            headings[i] = -math.pi if angle >= math.pi else angle
    return headings, later


@kernel("f1 f2 f2 b1 f")
def turned_headings(
    yaw: FloatArray, before: FloatArray, after: FloatArray, coasting: BoolArray, moving: float
) -> FloatArray:
    """Headings (n,) of coasting tracks turned as their velocities (n, 2) are, where these are above `moving`."""
    headings = np.empty(len(yaw))
    for i in range(len(yaw)):
        u, v, turn = before[i, 0], before[i, 1], 0.0
        if coasting[i] and math.hypot(u, v) > moving:
            turn = math.atan2(u * after[i, 1] - v * after[i, 0], u * after[i, 0] + v * after[i, 1])
        angle = (yaw[i] + turn + math.pi) % (2 * math.pi) - math.pi
        headings[i] = -math.pi if angle >= math.pi else angle
    return headings


Places = tuple[FloatArray, FloatArray, FloatArray]


@kernel("f1 f2 f3 f2 f2 f3 f3 f f f f f")
def predicted_places(
    s: FloatArray,
    place: FloatArray,
    D: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    dt: float,
    start: float,
    stop: float,
    drift: float,
    halting_speed: float,
) -> Places:
    """s (n,), a (n, 2), D (n, 2, 2) after `dt` s; start, stop: rates, 1/s."""
    n, h2 = len(s), halting_speed**2
    later, places, covariance = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    for k in range(n):
        x, y = velocity[k, 0], velocity[k, 1]
        a, b, c = P_velocity[k, 0, 0] + h2, P_velocity[k, 0, 1], P_velocity[k, 1, 1] + h2
        det = a * c - b * b
        halting = stop * (h2 * math.exp(-0.5 * ((c * x * x - 2 * b * x * y + a * y * y) / det + np.log(det))))
        rate = start + halting
        balance, lost = halting / max(rate, 1e-12), -math.expm1(-rate * dt)
        halts = (1 - s[k]) * balance * lost
        later[k] = s[k] * (1 - (1 - balance) * lost) + halts
        new = halts / max(later[k], 1e-12)
        for i in range(2):
            places[k, i] = place[k, i] + new * (position[k, i] - place[k, i])
            for j in range(2):
                apart = (position[k, i] - place[k, i]) * (position[k, j] - place[k, j])
                covariance[k, i, j] = (1 - new) * D[k, i, j] + new * P[k, i, j] + new * (1 - new) * apart
            covariance[k, i, i] += drift**2 * dt
    return later, places, covariance


@kernel("f1 f2 f3 i1 f2 f3 f2 f2 f3 f3 b1 f")
def updated_places(
    s: FloatArray,
    place: FloatArray,
    D: FloatArray,
    rows: IntArray,
    z: FloatArray,
    R: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    with_velocity: BoolArray,
    most_log_odds: float,
) -> Places:
    """s (k,), a (k, 2), D (k, 2, 2) of the tracks `rows` (k,) after detections z (k, 4) of covariance R (k, 4, 4); the
    other arrays (k, ...) are of these tracks."""
    n = len(rows)
    later, places, covariance = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    for k in range(n):
        i = rows[k]
        x, y = z[k, 0] - place[i, 0], z[k, 1] - place[i, 1]
        a, b, c = D[i, 0, 0] + R[k, 0, 0], D[i, 0, 1] + R[k, 0, 1], D[i, 1, 1] + R[k, 1, 1]
        det = a * c - b * b
        evidence = -0.5 * ((c * x * x - 2 * b * x * y + a * y * y) / det + np.log(det))
        for p in range(2):  # gain D S^-1
            g, h = (c * D[i, 0, p] - b * D[i, 1, p]) / det, (a * D[i, 1, p] - b * D[i, 0, p]) / det
            places[k, p] = place[i, p] + g * x + h * y
            for q in range(2):
                covariance[k, p, q] = D[i, p, q] - g * D[i, 0, q] - h * D[i, 1, q]
        for part in range(3):  # if it moves: its position; its velocity against none
            if part > 0 and not with_velocity[k]:
                break
            at = 0 if part == 0 else 2
            u, v = z[k, at], z[k, at + 1]
            a, b, c = R[k, at, at], R[k, at, at + 1], R[k, at + 1, at + 1]
            if part == 0:
                u, v = u - position[k, 0], v - position[k, 1]
                a, b, c = a + P[k, 0, 0], b + P[k, 0, 1], c + P[k, 1, 1]
            elif part == 1:
                u, v = u - velocity[k, 0], v - velocity[k, 1]
                a, b, c = a + P_velocity[k, 0, 0], b + P_velocity[k, 0, 1], c + P_velocity[k, 1, 1]
            det = a * c - b * b
            density = -0.5 * ((c * u * u - 2 * b * u * v + a * v * v) / det + np.log(det))
            evidence += density if part == 2 else -density
        before = min(max(s[i], 1e-9), 1 - 1e-9)
        odds = math.log(before / (1 - before)) + evidence
        odds = min(max(odds, -most_log_odds), most_log_odds)
        later[k] = 1 / (1 + math.exp(-odds))
    return later, places, covariance


@kernel("f1 b1 f2 f2 f3 f3 f2 f3")
def reported_moments(
    s: FloatArray,
    unseen: BoolArray,
    position: FloatArray,
    velocity: FloatArray,
    P: FloatArray,
    P_velocity: FloatArray,
    place: FloatArray,
    D: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position, velocity (n, 2) and covariances (n, 2, 2) over both cases; positions of `unseen` (n,) tracks alone."""
    n = len(s)
    x, v = np.empty((n, 2)), np.empty((n, 2))
    X, V = np.empty((n, 2, 2)), np.empty((n, 2, 2))
    for k in range(n):
        share, still = s[k], s[k] if unseen[k] else 0.0
        for i in range(2):
            v[k, i] = velocity[k, i] - share * velocity[k, i]
            x[k, i] = position[k, i] + still * (place[k, i] - position[k, i])
            for j in range(2):
                spread = share * (1 - share) * (velocity[k, i] * velocity[k, j])
                V[k, i, j] = (1 - share) * P_velocity[k, i, j] + spread
                spread = still * (1 - still) * ((place[k, i] - position[k, i]) * (place[k, j] - position[k, j]))
                X[k, i, j] = (1 - still) * P[k, i, j] + still * D[k, i, j] + spread
    return x, v, X, V


Prior = tuple[FloatArray, FloatArray, FloatArray]


@kernel("i1 i1 f2 f1 f1 f1 f1 i1 i1 f2 f1 f1 f1 f1 i1 f2 f1 f1 f f f f f f f f")
def prior_of_traffic(
    left: IntArray,
    left_class: IntArray,
    left_position: FloatArray,
    left_heading: FloatArray,
    left_speed: FloatArray,
    left_variance: FloatArray,
    left_stationary: FloatArray,
    latest: IntArray,
    latest_class: IntArray,
    latest_position: FloatArray,
    latest_heading: FloatArray,
    latest_speed: FloatArray,
    latest_variance: FloatArray,
    latest_stationary: FloatArray,
    new_class: IntArray,
    position: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    stationary: float,
    weight: float,
    ahead_scale: float,
    lateral_scale: float,
    heading_scale: float,
    spread: float,
    most_variance: float,
    farthest: float,
) -> Prior:
    """Probability of being stationary, speed ahead and its variance (k,) of new tracks at `position` (k, 2).

    Of passages, in two sets: ids of tracks, numbers of classes, position (n, 2), heading, speed, variance, stationary
    (n,), used where the variance is below `most_variance`; of k new tracks: class, position, heading, NaN: unknown, and
    variance without neighbours; farthest: exponent from which a passage does not count
    """
    sets = (left, latest)
    classes, places, headings = (
        (left_class, latest_class),
        (left_position, latest_position),
        (left_heading, latest_heading),
    )
    speeds, variances = (left_speed, latest_speed), (left_variance, latest_variance)
    resting = (left_stationary, latest_stationary)
    k = len(new_class)
    still, mean, spreads = np.empty(k), np.empty(k), np.empty(k)
    low, high = 0, -1
    for which in range(2):
        for i in sets[which]:
            low, high = (i, i) if high < low else (min(low, i), max(high, i))
    largest = np.zeros(high - low + 1)  # of each track
    nearest = np.empty(high - low + 1, dtype=np.int64)
    for t in range(k):
        c, s = math.cos(heading[t]), math.sin(heading[t])
        largest[:] = 0.0
        for which in range(2):
            begin = which * len(left)
            for p in range(len(sets[which])):
                if classes[which][p] != new_class[t] or not variances[which][p] < most_variance:
                    continue
                x, y = places[which][p, 0] - position[t, 0], places[which][p, 1] - position[t, 1]
                ahead, lateral = (x * c + y * s) / ahead_scale, (y * c - x * s) / lateral_scale
                exponent = ahead**2 + lateral**2
                if not exponent < farthest:
                    continue
                turn = (headings[which][p] - heading[t] + math.pi) % (2 * math.pi) - math.pi
                exponent += (turn / heading_scale) ** 2
                if exponent < farthest:
                    share, slot = weight * math.exp(-exponent / 2), sets[which][p] - low
                    if share >= largest[slot]:
                        largest[slot], nearest[slot] = share, begin + p
        total, moving, resting_total, speed, square = 0.0, 0.0, 0.0, 0.0, 0.0
        for slot in range(len(largest)):
            share = largest[slot]
            if share > 0:
                which = 1 if nearest[slot] >= len(left) else 0
                p = nearest[slot] - which * len(left)
                total += share
                resting_total += share * resting[which][p]
                share *= 1 - resting[which][p]
                v = speeds[which][p]
                moving += share
                speed += share * v
                square += share * (v**2 + variances[which][p] + spread**2)
        still[t] = (stationary + resting_total) / (1 + total)
        norm = 1 - stationary + moving
        mean[t] = speed / norm
        spreads[t] = ((1 - stationary) * variance[t] + square) / norm - mean[t] ** 2
    return still, mean, spreads


@kernel_part
def _enumerated(row: IntArray, column: IntArray, weight: FloatArray, free: FloatArray, m: int) -> FloatArray:
    """Marginals (K,) of pairs over all joint events; free (n,) weights of rows left alone; m columns."""
    n, K, masks = len(free), len(row), 1 << m
    forward, backward, p = np.zeros((n + 1, masks)), np.ones((n + 1, masks)), np.zeros(K)
    forward[0, 0] = 1.0
    for i in range(n):
        forward[i + 1] = forward[i] * free[i]
        for k in range(K):
            for mask in range(masks if row[k] == i else 0):
                if not mask >> column[k] & 1:
                    forward[i + 1, mask | 1 << column[k]] += forward[i, mask] * weight[k]
        forward[i + 1] /= forward[i + 1].sum()
    for i in range(n - 1, -1, -1):
        backward[i] = backward[i + 1] * free[i]
        for k in range(K):
            for mask in range(masks if row[k] == i else 0):
                if not mask >> column[k] & 1:
                    term = weight[k] * backward[i + 1, mask | 1 << column[k]]
                    backward[i, mask] += term
                    p[k] += forward[i, mask] * term
        total = (forward[i] * backward[i]).sum()
        for k in range(K):
            if row[k] == i:
                p[k] /= total
        backward[i] /= backward[i].max()
    return p


@kernel_part
def _propagated(
    row: IntArray, column: IntArray, weight: FloatArray, free: FloatArray, m: int, sweeps: int
) -> FloatArray:
    """Marginals (K,) of pairs by loopy belief propagation; free (n,) weights of leaving rows alone; m columns."""
    K, change = len(row), 1.0
    nu, mu = np.ones(K), np.empty(K)
    for sweep in range(sweeps + 1):
        total = free.copy()
        for k in range(K):
            total[row[k]] += weight[k] * nu[k]
        if sweep == sweeps or change < 1e-9:
            break
        back, change = np.ones(m), 0.0
        for k in range(K):
            mu[k] = weight[k] / max(total[row[k]] - weight[k] * nu[k], 1e-300)
            back[column[k]] += mu[k]
        for k in range(K):
            new = 1 / max(back[column[k]] - mu[k], 1e-300)
            change = max(change, abs(new - nu[k]))
            nu[k] = new
    for k in range(K):
        mu[k] = weight[k] * nu[k] / total[row[k]]
    return mu


@kernel("i1 i1 f1 i i")
def association_marginals(
    track: IntArray, detection: IntArray, log_weight: FloatArray, largest: int, sweeps: int
) -> FloatArray:
    """Probabilities (K,) of pairs of tracks and detections over all joint events, each in one pair at most.

    log_weight (K,): log of the weight of a pair, where a track and a detection apart have 1; the weight of an event is
    the product. Components with at most `largest` tracks or detections are exact, by a recursion over the other side
    that carries the set of those taken; the others by loopy belief propagation, at most `sweeps` sweeps.

    Source: Williams and Lau, Approximate evaluation of marginal association probabilities with belief propagation,
    IEEE Transactions on Aerospace and Electronic Systems 50(4), 2014.
    """
    K, n, m = len(track), 0, 0
    for k in range(K):
        n, m = max(n, track[k] + 1), max(m, detection[k] + 1)
    parent, component, result = np.arange(n + m), np.empty(K, dtype=np.int64), np.empty(K)
    for k in range(K):
        parent[root_of(parent, n + detection[k])] = root_of(parent, track[k])
    for k in range(K):
        component[k] = root_of(parent, track[k])
    order, number, at = np.argsort(component, kind="mergesort"), np.full(n + m, -1), 0
    while at < K:
        end, counts = at, [0, 0]
        while end < K and component[order[end]] == component[order[at]]:
            for side in range(2):
                node = track[order[end]] if side == 0 else n + detection[order[end]]
                if number[node] < 0:
                    number[node] = counts[side]
                    counts[side] += 1
            end += 1
        part = order[at:end]
        first, second, weight = number[track[part]], number[n + detection[part]], log_weight[part]
        if counts[1] > counts[0]:
            first, second = second, first
        most = np.zeros(max(counts))
        for e in range(len(part)):
            most[first[e]] = max(most[first[e]], weight[e])
        weight, free = np.exp(weight - most[first]), np.exp(-most)  # each row scaled, which changes no probability
        if min(counts) <= largest:
            result[part] = _enumerated(first, second, weight, free, min(counts))
        else:
            result[part] = _propagated(first, second, weight, free, min(counts), sweeps)
        at = end
    return result
