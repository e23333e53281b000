"""Rates of edges by the shipped rules, and pairs of vehicles in one lane.

Rates of edges by the shipped rules, see `saga_fg.model.edge_rules`.

Of E pairs: rows `target` (E,), ascending, and `source` (E,) of n nodes, and where the source is along the path of the
target: ahead, aside, direction there, and whether the path is a predicted one (E,).
"""

import math

import numpy as np

from saga_fg.kernels.compilation import BoolArray, FloatArray, IntArray, kernel, kernel_part

Led = tuple[IntArray, IntArray, FloatArray]


@kernel_part
def wrapped(angle: float) -> float:
    """An angle in [-pi, pi), rad."""
    angle = (angle + math.pi) % (2 * math.pi) - math.pi
    return -math.pi if angle >= math.pi else angle


@kernel_part
def gain(own: float, other: float, spread: float) -> float:
    """Information gain by variances of velocities; 1 for a `spread` below 0."""
    if spread < 0:
        return 1.0
    total = own + other + spread * spread
    return own / total if total > 0 else 0.0


@kernel("i1 i1 f1 f1 f1 b1 f2 f1 f1 f1 f1 f1 f f f f f b i f f f f")
def leader_rates(
    target: IntArray,
    source: IntArray,
    ahead: FloatArray,
    aside: FloatArray,
    direction: FloatArray,
    predicted: BoolArray,
    position: FloatArray,
    heading: FloatArray,
    length: FloatArray,
    moved: FloatArray,
    exists: FloatArray,
    variance: FloatArray,
    rate: float,
    max_gap: float,
    gap_scale: float,
    lateral_scale: float,
    heading_scale: float,
    parked: bool,
    leaders: int,
    min_separation: float,
    spread: float,
    steepest: float,
    least: float,
) -> Led:
    """The pairs (k,) whose sources lead, with their rates

        share rate gain none_before e^-d
        d = ahead / gap_scale + (turn / heading_scale)^2 / 2 + (lateral / lateral_scale)^2 / 2

    ahead and lateral along the path of the target, on an arc aside by ahead tan(turn / 2) where none is predicted;
    none_before: the probability that no vehicle before the source exists. Left out are sources beyond three scales.

    Of n nodes: position (n, 2), heading, length, moved, exists, variance of the velocity (n,); leaders: 0 any, 1 those
    that have moved, 2 others; spread: that of the information gain, below 0 without it; steepest: largest turn of an
    arc; least: probability below which it is certain that a source exists
    """
    E, k = len(target), 0
    chosen, strength, remoteness = np.empty(E, dtype=np.int64), np.empty(E), np.empty(E)
    for e in range(E):
        i, j = target[e], source[e]
        turn = wrapped(direction[e] - heading[j])
        lateral = aside[e]
        if not predicted[e]:
            lateral += ahead[e] * math.tan(min(max(turn, -steepest), steepest) / 2)
        if not (abs(lateral) < 3 * lateral_scale and abs(turn) < 3 * heading_scale and ahead[e] > 0):
            continue
        if not math.hypot(position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]) <= max_gap:
            continue
        if not ahead[e] >= min_separation * (length[i] + length[j]) / 2:
            continue
        share = 1.0 if parked and abs(lateral) <= lateral_scale else moved[i]
        if leaders > 0:
            share *= moved[j] if leaders == 1 else 1 - moved[j]
        exponent = (turn / heading_scale) ** 2 + (lateral / lateral_scale) ** 2
        strength[k] = share * (rate * math.exp(-ahead[e] / gap_scale - exponent / 2))
        strength[k] *= gain(variance[i], variance[j], spread)
        chosen[k], remoteness[k] = e, ahead[e] + 10 * abs(lateral)
        k += 1
    order, begin = np.empty(k, dtype=np.int64), 0
    while begin < k:  # of each target the nearest first: those behind it lead if it does not exist
        end = begin
        while end < k and target[chosen[end]] == target[chosen[begin]]:
            at = end
            while at > begin and remoteness[order[at - 1]] > remoteness[end]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = end
            end += 1
        missing = 0.0
        for at in range(begin, end):
            nearer = math.exp(missing)
            missing += math.log1p(-min(exists[source[chosen[order[at]]]], 1 - least))
            strength[order[at]] *= nearer if nearer > 2 * least else 0.0
        begin = end
    count = 0
    for e in range(k):
        if strength[e] > 0:
            chosen[count], strength[count] = chosen[e], strength[e]
            count += 1
    return target[chosen[:count]], source[chosen[:count]], strength[:count].copy()


@kernel("i1 i1 f1 f2 f2 f1 f1 f f f f f f i f")
def neighbour_rates(
    target: IntArray,
    source: IntArray,
    direction: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    rate: float,
    distance_scale: float,
    heading_scale: float,
    speed_scale: float,
    max_distance: float,
    min_speed: float,
    degree: int,
    spread: float,
) -> Led:
    """At most `degree` pairs (k,) into each node, the strongest first, with their rates

        rate exp(-((distance / distance_scale)^2 + (turn / heading_scale)^2 + (faster / speed_scale)^2) / 2) gain

    faster: size of the difference of velocities. Of n nodes: position, velocity (n, 2), heading, variance of the
    velocity (n,); spread as above
    """
    E, k = len(target), 0
    strength, order = np.empty(E), np.empty(E, dtype=np.int64)
    for e in range(E):
        i, j = target[e], source[e]
        own = math.hypot(velocity[i, 0], velocity[i, 1])
        other = math.hypot(velocity[j, 0], velocity[j, 1])
        apart = math.hypot(position[j, 0] - position[i, 0], position[j, 1] - position[i, 1])
        faster = math.hypot(velocity[j, 0] - velocity[i, 0], velocity[j, 1] - velocity[i, 1])
        turn = wrapped(direction[e] - heading[j])
        exponent = (apart / distance_scale) ** 2 + (turn / heading_scale) ** 2
        strength[e] = 0.0
        if own >= min_speed and other >= min_speed and apart <= max_distance:
            strength[e] = rate * math.exp(-(exponent + (faster / speed_scale) ** 2) / 2)
        strength[e] *= gain(variance[i], variance[j], spread)
    begin = 0
    while begin < E:
        end, kept = begin, k
        while end < E and target[end] == target[begin]:
            at = k
            while at > kept and strength[order[at - 1]] < strength[end]:
                at -= 1
            if at - kept < degree:
                k = min(k + 1, kept + degree)
                for later in range(k - 1, at, -1):
                    order[later] = order[later - 1]
                order[at] = end
            end += 1
        begin = end
    order = order[:k]
    return target[order], source[order], strength[order]


@kernel("f2 f1 b1 b1 f f f i1 f2 f1 f1 f1 f")
def pairs_ahead(
    position: FloatArray,
    heading: FloatArray,
    follows: BoolArray,
    able: BoolArray,
    farthest: float,
    aside: float,
    widening: float,
    path: IntArray,
    begin: FloatArray,
    direction: FloatArray,
    turn: FloatArray,
    margin: FloatArray,
    sharp: float,
) -> tuple[IntArray, IntArray]:
    """Rows (E,) of targets that follow and of able sources ahead of them, up to `farthest` m away.

    Of n nodes: position (n, 2), heading, follows, able (n,), path (n,), -1 for none; of k paths: begin (k, 2) and
    direction (k,) there, turn, margin (k,) as in `saga_fg.model.interactions.Paths.cones`. Without a path a source is
    ahead by x and at most aside + widening x beside; on one that turns by more than `sharp` all may be.
    """
    n, k = len(position), 0
    low, high = math.inf, -math.inf
    for j in range(n):
        if able[j]:
            low, high = min(low, position[j, 0]), max(high, position[j, 0])
    strips = int(min(max((high - low) / max(farthest, 1e-9), 0.0), n)) + 1  # along x, at least as wide as `farthest`
    width = max((high - low) / strips * (1 + 1e-9), farthest)
    first, following = np.full(strips + 1, -1, dtype=np.int64), np.empty(n, dtype=np.int64)
    for j in range(n - 1, -1, -1):
        if able[j]:
            strip = int((position[j, 0] - low) / width)
            following[j], first[strip] = first[strip], j
    room = 16 * n + 64
    found = np.empty((2, room), dtype=np.int64)
    for i in range(n):
        if not follows[i] or not high >= low:
            continue
        if k + n > room:
            room = 2 * room + n
            longer = np.empty((2, room), dtype=np.int64)
            for e in range(k):
                longer[0, e], longer[1, e] = found[0, e], found[1, e]
            found = longer
        p = path[i]
        angle = heading[i] if p < 0 else direction[p]
        c, s = math.cos(angle), math.sin(angle)
        x, y = position[i, 0], position[i, 1]
        cos_turn, sin_turn = (math.cos(turn[p]), math.sin(turn[p])) if p >= 0 else (1.0, 0.0)
        own, of_i = math.floor((x - low) / width), k
        for strip in range(max(own - 1, 0), min(own + 1, strips) + 1):
            j = first[strip]
            while j >= 0:
                dx, dy = position[j, 0] - x, position[j, 1] - y
                there = i != j and dx * dx + dy * dy <= farthest * farthest
                if there and p < 0:
                    ahead = dx * c + dy * s
                    there = ahead > 0 and abs(dy * c - dx * s) <= aside + widening * ahead
                elif there:
                    dx, dy = position[j, 0] - begin[p, 0], position[j, 1] - begin[p, 1]
                    ahead = dx * c + dy * s
                    beside = abs(dy * c - dx * s) * cos_turn - ahead * sin_turn <= margin[p]
                    there = turn[p] > sharp or (ahead >= -margin[p] and beside)
                if there:
                    at = k
                    while at > of_i and found[1, at - 1] > j:
                        found[1, at] = found[1, at - 1]
                        at -= 1
                    found[0, k], found[1, at] = i, j
                    k += 1
                j = following[j]
    return found[0, :k].copy(), found[1, :k].copy()
