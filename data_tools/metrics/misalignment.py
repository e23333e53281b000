"""Why no track matches: the shift, turn or unit that would bring tracks onto the true objects.

A reading explains the tracks if it matches half of the boxes there are and more, of several objects, each by one track
for several moments. So neither a crowd, where something is near everywhere, nor one object, which an offset always
brings onto another, is taken for a shift.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from data_tools.metrics.scene_boxes import SceneBoxes, near_pairs, nearest_pairs
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.types import Scene

_GATE = 2.0  # m, from which a pair cannot match
_MIN_RECALL = 0.1  # recall from which AMOTA counts what matches
_EXPLAINED, _BETTER = 0.5, 2.0  # share of boxes that a reading matches, and how many times what matches as given
_CLEAR = 0.6  # share of the pairs with an offset that another one may have, as along a row of parked cars
_OBJECTS, _MOMENTS = 5, 5  # objects that it matches, and moments at which one track matches an object
_FRAMES, _LAGS, _FARTHEST = 200, 50, 1e7  # moments compared, by which times may be moved, and m of an offset
_AXES = {
    "with x and y exchanged": ((0, 1), (1, 0)),
    "turned by 90 degrees": ((0, -1), (1, 0)),
    "turned by -90 degrees": ((0, 1), (-1, 0)),
    "turned by 180 degrees": ((-1, 0), (0, -1)),
    "with x mirrored": ((-1, 0), (0, 1)),
    "with y mirrored": ((1, 0), (0, -1)),
    "read as feet": ((0.3048, 0), (0, 0.3048)),
    "read as centimetres": ((0.01, 0), (0, 0.01)),
    "read as kilometres": ((1000, 0), (0, 1000)),
}


def misalignment(scenes: Sequence[tuple[Scene, SceneBoxes]]) -> str:
    """Say what would have matched where hardly any track matches a true object, judged by the largest scene.

    Empty where something matches, and where tracks and true objects have no class in common.
    """
    judged = [(scene, found) for scene, found in scenes if scene.ground_truth is not None and len(found)]
    if not judged:
        return ""
    scene, found = max(judged, key=lambda pair: len(pair[1]))
    truth = SceneBoxes.of_annotations((scene.ground_truth or ())[:_FRAMES], hidden=False)
    found = found.select(found.frame < _FRAMES)
    reached, *_ = near_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), _GATE)
    reach = len(np.unique(reached)) / max(len(truth), 1)
    if reach >= _EXPLAINED or not np.isin(truth.boxes.label, found.boxes.label).any():
        return ""
    given = _matched(truth, found, found.frame, found.boxes.position[:, :2])
    shares = {how: _matched(truth, found, frame, place) for how, frame, place in _readings(scene, truth, found)}
    best = max(shares.values())
    if best < max(_EXPLAINED, _BETTER * given):
        none = "hardly a track is near a true object; no usual unit, turn, offset or shift in time explains it"
        return none if reach < _MIN_RECALL else ""
    how = next(how for how, share in shares.items() if share > best - 0.02)  # the plainest of those that fit alike
    return f"tracks match {given:.0%} of the boxes for long; {how}, they would match {shares[how]:.0%}"


def _readings(scene: Scene, truth: SceneBoxes, found: SceneBoxes) -> Iterator[tuple[str, IntArray, FloatArray]]:
    """Yield what each reading is called, the moments (N,) and the places (N, 2) of the tracks by it."""
    place, pose = found.boxes.position[:, :2], scene.world_T_ego[found.frame]
    R, t = pose[:, :2, :2], pose[:, :2, 3]
    yield "moved from the vehicle's frame to the world", found.frame, np.einsum("nij,nj->ni", R, place) + t
    yield "moved from the world to the vehicle's frame", found.frame, np.einsum("nji,nj->ni", R, place - t)
    for how, matrix in _AXES.items():
        yield how, found.frame, place @ np.array(matrix, dtype=np.float64).T
    step = float(np.median(np.diff(scene.timestamps))) if len(scene) > 1 else 0.0
    for lag in range(1, min(_LAGS, len(scene) - 1) + 1):
        for sign in (1, -1):
            yield f"{sign * lag * step:+.4g} s later", found.frame + sign * lag, place
    pairs = near_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), _FARTHEST)
    apart = truth.boxes.position[pairs[0], :2] - found.boxes.position[pairs[1], :2]
    offset, votes = _usual_offset(apart)
    _, others = _usual_offset(apart[np.hypot(*(apart - offset).T) > 3 * _GATE])
    if others < _CLEAR * votes:
        yield f"moved by {offset[0]:.1f}, {offset[1]:.1f} m", found.frame, place + offset


def _usual_offset(apart: FloatArray) -> tuple[FloatArray, int]:
    """The offset (2,) that most of the pairs (P, 2) have, and how many have it."""
    if not len(apart):
        return np.zeros(2), 0
    cells, count = np.unique(np.rint(apart / _GATE), axis=0, return_counts=True)
    near = np.abs(apart - _GATE * cells[np.argmax(count)]).max(axis=1) < _GATE
    return np.median(apart[near], axis=0), int(near.sum())


def _matched(truth: SceneBoxes, found: SceneBoxes, frame: IntArray, place: FloatArray) -> float:
    """Share of the boxes that match for long, of tracks at other moments (N,) and places (N, 2); 0 for few objects."""
    place = place.clip(-_FARTHEST, _FARTHEST)
    boxes = replace(found.boxes, position=np.column_stack([place, found.boxes.position[:, 2]]))
    row, column, _ = nearest_pairs((truth.frame, truth.boxes), (frame, boxes), _GATE)
    names, count = np.unique(np.stack([truth.id[row], found.id[column]]), axis=1, return_counts=True)
    lasting = count >= _MOMENTS
    if len(np.unique(names[0, lasting])) < _OBJECTS:
        return 0.0
    return float(count[lasting].sum()) / min(len(truth), len(found))
