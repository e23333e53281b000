"""Velocities of annotated objects by central differences of their positions.

    v_k = (p_{k+r} - p_{k-r}) / (t_{k+r} - t_{k-r})

over the annotations k of one object in order of time; at the ends of its annotations the difference is one-sided. With
r = 1 and 1.5 s as the longest gap this is `NuScenes.box_velocity` of the nuScenes development kit.
"""

import numpy as np

from saga_fg.numerics import FloatArray, IntArray, StrArray


def central_differences(
    instance: StrArray, time: FloatArray, position: FloatArray, longest_gap: float, reach: int = 1
) -> FloatArray:
    """Velocities (N, 2), m/s, of annotations with instance names (N,), times (N,) in s, positions (N, 2) in m.

    The annotations come in any order. `reach` is r above. Unknown (NaN) for an object annotated once, and where more
    than `longest_gap` s per annotation lie between the two annotations.
    """
    n = len(instance)
    velocity = np.full((n, 2), np.nan)
    if n < 2:
        return velocity
    order = np.lexsort((time, instance))
    same = instance[order][1:] == instance[order][:-1]
    rank = np.arange(n)
    previous: IntArray = rank - np.append(False, same)
    following: IntArray = rank + np.append(same, False)
    before, after = rank, rank
    for _ in range(reach):
        before, after = previous[before], following[after]
    t, p = time[order], position[order]
    elapsed = t[after] - t[before]
    known = (elapsed > 0) & (elapsed <= longest_gap * (after - before))
    with np.errstate(over="ignore"):  # infinite positions are refused elsewhere
        velocity[order[known]] = (p[after] - p[before])[known] / elapsed[known, None]
    return velocity
