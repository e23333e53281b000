r"""Class confusion of a sensor: how often objects of each class are reported as another, from matches to the truth.

    A(z | c) = ( n_cz + 1 ) / ( n_c + k )

n_cz of the n_c detections of objects of class c were reported as z, among the k classes of its group: the posterior
mean with a uniform prior.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from saga_fg.learning.truth_matches import match_to_truth
from saga_fg.model.sensor import Sensor
from saga_fg.types.dataset import Scene

FEWEST = 20  # detections of a class, for a row of its own


def learn_confusion(
    scenes: Iterable[Scene], sensors: Mapping[str, Sensor], groups: Sequence[Sequence[str]]
) -> dict[str, dict[str, dict[str, float]]]:
    """Sensor -> true class -> reported class -> share, for classes in `groups` with enough detections.

    Raises `InputError` for a scene without ground truth.
    """
    seen: dict[str, Counter[tuple[str, str]]] = {}
    for scene in scenes:
        for matched in match_to_truth(scene, sensors, groups=groups):
            true = matched.annotations.boxes.label[matched.truth].tolist()
            reported = matched.detections.boxes.label[matched.detection].tolist()
            seen.setdefault(matched.frame.sensor, Counter()).update(zip(true, reported, strict=True))
    return {name: _tables(counts, groups) for name, counts in seen.items()}


def _tables(counts: Counter[tuple[str, str]], groups: Sequence[Sequence[str]]) -> dict[str, dict[str, float]]:
    tables = {}
    for group in groups:
        for label in group:
            total = sum(counts[label, other] for other in group)
            if total >= FEWEST:
                shares = {other: (counts[label, other] + 1) / (total + len(group)) for other in group}
                tables[label] = {other: round(share, 4) for other, share in shares.items()}
    return tables
