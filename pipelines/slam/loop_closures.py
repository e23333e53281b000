"""Loop closures: submaps that look alike from above, proved by registration and by agreement.

1. Recognition (`data_tools.lidar.places`): the images of older submaps that are most like the new one are aligned with
   it, without a guess. Submaps further off than any drift are left out.
2. Proof: the best are registered, and what stands above the ground must lie on each other, in both directions, where
   both have seen. A place that has a rival is no loop: the same submap aligned otherwise, or another one that says that
   the vehicle is elsewhere.
3. Drift: errors of relative poses grow with the way between two submaps along measurements. A loop within what
   odometry may be off is believed at once; one further off must be proved better, or waits until another one, found
   later on the way, agrees with it. Then odometry is wrong, and the loop is `confirmed`: no robust loss gives it up.

The submaps of a drive and the loops between them, searched for once for every submap, when it is closed.

    search.add(submap, world_T_submap)  ->  loops between this submap and older ones

A loop says where the frame of one submap is in that of another. It enters the running graph as a factor between the two
anchors, under a robust loss.

The proof that two clouds show one place: registration, first rough and then fine, and rivals.

A place that fits nearly as well elsewhere is none: the same two clouds aligned otherwise (row houses), or another place
that says that the vehicle is elsewhere (streets that look alike).

Acceptance of loop closures by agreement of several, for the planar laser and the LiDAR.

A loop within the drift of odometry is accepted at once. Any other waits for a second one, found from another place on
the way, that agrees with it: both loops and the odometry between their ends compose to the identity.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from data_tools.lidar import (
    PlaceImage,
    PlaceIndex,
    PlaceMatch,
    Registration,
    RegistrationError,
    Structure,
    Submap,
    SurfelMap,
    Undetermined,
    register,
    upright,
    voxel_downsample,
)
from data_tools.trajectories import rotation_angle
from pipelines.slam.drive import LEAST, placed_clouds
from saga_fg.numerics import FloatArray, IntArray, carried_covariance, inverse_transform
from saga_fg.settings import Fraction, Positive, Settings, setting
from saga_fg.slam.pose_graph.optimisation import shortest_paths
from saga_fg.slam.submaps import LoopClosure, LoopSelection, SubmapGraph


def deviation(T: FloatArray) -> FloatArray:
    """Translation, m, and rotation, rad, (2,) of a transform (4, 4)."""
    return np.array([np.linalg.norm(T[:3, 3]), rotation_angle(T[:3, :3])])


@dataclass(eq=False)
class Agreement:
    """Loops that wait for another one that agrees with them.

    within    largest difference of two loops that agree (2,), m and rad; `drift` (2,) more for each m between them
    patience  m travelled while a loop waits
    apart     least distance travelled between the places that the two are found from, m
    """

    within: FloatArray
    drift: FloatArray
    patience: float
    apart: float = 0.0
    _waiting: list[LoopClosure] = field(default_factory=list)

    def confirmed(
        self, loop: LoopClosure, between: Callable[[int, int], FloatArray], travelled: Callable[[int], float]
    ) -> Sequence[LoopClosure]:
        """The loop with those of before that agree with it; it waits if there are none.

        between: pose of the second in the frame of the first, by odometry; travelled: until a pose, m
        """
        now = travelled(loop.second)
        agreed, waiting = list[LoopClosure](), list[LoopClosure]()
        for other in (each for each in self._waiting if travelled(each.second) > now - self.patience):
            far = abs(travelled(loop.first) - travelled(other.first)) + abs(now - travelled(other.second))
            one = between(other.first, loop.first) @ loop.first_T_second
            off = deviation(np.linalg.inv(one) @ other.first_T_second @ between(other.second, loop.second))
            fits = now - travelled(other.second) >= self.apart and (off < self.within + self.drift * far).all()
            (agreed if fits else waiting).append(other)
        self._waiting = waiting if agreed else [*waiting, loop]
        return [loop, *agreed] if agreed else []


FEWEST = 200  # points of a submap that shows a place
COMPARED = 12  # places whose images are compared in each search
SURFEL, SPACING = 1.0, 1.5  # m: voxels of the map, and spacing of the points registered
SAME = 4.0  # m that two findings of one place differ by, besides drift
_SINGLE = 0.8  # share of the correlation that another alignment of the two may have
_UNIQUE = 0.92  # share of the structure in common that another place may have


def registered(
    old: FloatArray,
    points: FloatArray,
    old_T_points: FloatArray,
    undetermined: Undetermined = "refuse",
) -> Registration | None:
    """Register points (N, 3) with the points (M, 3) of a place, from an alignment of images; None: they do not fit."""
    surfels = SurfelMap(SURFEL, reach=np.inf)
    surfels.add(old, np.zeros(3))
    try:
        rough = register(points, surfels, old_T_points, 3 * SURFEL, 1.0, undetermined)
        fine = register(points, surfels, rough.map_T_scan, SURFEL, 0.1, undetermined)
    except RegistrationError:
        return None
    return fine if fine.converged else None


def fits_otherwise(match: PlaceMatch) -> bool:
    """True if another alignment of the two is nearly as good."""
    return match.rival > _SINGLE * match.score


def agreeing(places: FloatArray, overlap: FloatArray, spread: FloatArray | float = SAME) -> Sequence[int]:
    """Those of the places (P, 3), m, that agree with the first; none if another is nearly as good and says otherwise.

    overlap (P,) of each, spread (P,) m that it may be off the first
    """
    elsewhere = np.linalg.norm(places - places[0], axis=1) >= spread
    if (overlap[elsewhere] > _UNIQUE * overlap[0]).any():
        return []
    return np.flatnonzero(~elsewhere).tolist()


_REGISTERED, _TAKEN = 4, 2  # places for each submap
_ALIKE = 0.3  # correlation of images from which places are registered
_SURELY = 0.75  # shared structure that a loop needs beyond the drift of odometry, with another that agrees
_ALONE = 0.85  # and without one, up to twice the drift
_FARTHEST = (35.0, 0.1)  # m, and m for each m travelled: beyond, two places are not the same
_OPEN = 0.5  # m, standard deviation of an alignment of images
DISTORTION = np.array([1e-3] * 3 + [0.05] * 3) ** 2  # rad^2 and m^2, of submaps, which are never quite straight


@dataclass(frozen=True)
class LoopSettings(Settings):
    """Conditions for taking two submaps for one place."""

    min_path: Positive = setting(60.0, "m travelled between two submaps that are compared; 50 to 100")
    min_overlap: Fraction = setting(
        0.6, "share of what stands above the ground that two submaps have in common; raised: fewer, surer loops"
    )
    drift: Positive = setting(
        0.03, "drift of odometry, share of the way: loops further off wait for another; raised for poor odometry"
    )


@dataclass(frozen=True, eq=False)
class _Proved:
    """A loop with the structure that both ends share, and how far it is off the estimate, by the drift of odometry."""

    loop: LoopClosure
    overlap: float
    drift: float


class LoopSearch(ABC):
    """Submaps in, loops out: `found` says which older submaps show the place of a new one.

    min_path: m travelled between two submaps that are compared; waiting: loops that need another one
    """

    def __init__(self, min_path: float, waiting: Agreement) -> None:
        self._min_path, self._waiting = min_path, waiting
        self._submaps = list[Submap]()
        self._edges = list[tuple[int, int, float]]()

    @abstractmethod
    def found(
        self, submap: Submap, older: IntArray, travelled: FloatArray, frames: FloatArray
    ) -> list[tuple[LoopClosure, bool]]:
        """Loops of a submap, and whether each waits for another one that agrees with it. Keep what the next need.

        older: numbers of the submaps to compare with; travelled: from each submap so far along measurements, m;
        frames: of all, as `add` has them
        """

    def driven(self, submap: Submap) -> float:
        """Distance travelled until the end of a submap, m, with which drift grows."""
        return submap.travelled[1]

    def add(self, submap: Submap, world_T_submap: FloatArray) -> Sequence[LoopClosure]:
        """Take the next submap and return loops, `first` and `second` numbers of submaps.

        world_T_submap: (number + 1, 4, 4) frames of all submaps so far, as estimated now, this one's last. A submap
        with too few points to show a place has no loops, now and later.
        """
        number = len(self._submaps)
        if number:
            self._edges.append((number - 1, number, self.driven(submap) - self.driven(self._submaps[-1])))
        older = [k for k, one in enumerate(self._submaps) if one.travelled[1] <= submap.travelled[0] - self._min_path]
        self._submaps.append(submap)
        taken: list[LoopClosure] = []
        for loop, waits in self.found(submap, np.array(older, dtype=np.int64), self._distances(number), world_T_submap):
            taken += self._confirmed(loop, world_T_submap) if waits else [loop]
        self._edges += [(loop.first, loop.second, float(deviation(loop.first_T_second)[0])) for loop in taken]
        return taken

    def _confirmed(self, loop: LoopClosure, frames: FloatArray) -> Sequence[LoopClosure]:
        agreed = self._waiting.confirmed(
            loop,
            lambda a, b: np.asarray(inverse_transform(frames[a]) @ frames[b]),
            lambda number: self._submaps[number].travelled[1],
        )
        return [replace(loop, confirmed=True) for loop in agreed]

    def _distances(self, number: int) -> FloatArray:
        """Distance from each submap so far to this one, along measurements, m."""
        if not self._edges:
            return np.zeros(len(self._submaps))
        first, second, length = (np.array(column) for column in zip(*self._edges, strict=True))
        return shortest_paths(first, second, length, len(self._submaps), number)


class PlaceLoops(LoopSearch):
    """Loops of a LiDAR, by place."""

    def __init__(self, settings: LoopSettings | None = None) -> None:
        self.settings = settings or LoopSettings()
        waiting = Agreement(np.array([2.0, 0.05]), np.array([0.05, 1e-3]), patience=150.0, apart=15.0)
        super().__init__(self.settings.min_path, waiting)
        self._index = PlaceIndex()

    def found(
        self, submap: Submap, older: IntArray, travelled: FloatArray, frames: FloatArray
    ) -> list[tuple[LoopClosure, bool]]:
        if len(submap.points) < FEWEST:
            return []
        number, image = len(frames) - 1, PlaceImage.of(submap.points.astype(np.float64))
        proved = self._proved(number, image, older, travelled, frames)
        self._index.add(number, image)
        believed = list[tuple[LoopClosure, bool]]()
        for one in proved[:_TAKEN]:
            if one.drift < 1:
                believed.append((one.loop, False))
            elif one.overlap >= _ALONE and one.drift < 2:
                believed.append((replace(one.loop, confirmed=True), False))
            elif one.overlap >= _SURELY:
                believed.append((one.loop, True))
        return believed

    def _proved(
        self, number: int, image: PlaceImage, older: IntArray, travelled: FloatArray, frames: FloatArray
    ) -> list[_Proved]:
        """Loops of the submap, without rivals, the best first."""
        apart = np.linalg.norm(frames[older, :3, 3] - frames[number, :3, 3], axis=1)
        length = self._submaps[number].travelled[1] - self._submaps[number].travelled[0]
        older = older[apart < self._farthest(travelled[older]) + 2 * length + 20.0]
        matches = self._index.candidates(image, older.tolist(), COMPARED)
        found = []
        for match in matches[:_REGISTERED]:
            if match.score < _ALIKE or fits_otherwise(match):
                continue
            loop, overlap = self._registered(match, number)
            if loop is not None and overlap >= self.settings.min_overlap:
                there = frames[loop.first] @ loop.first_T_second
                off = float(np.linalg.norm(there[:3, 3] - frames[number, :3, 3]))
                if off < self._farthest(travelled[match.number]):
                    found.append(_Proved(loop, overlap, (off - 1.0) / (self.settings.drift * travelled[match.number])))
        return self._unrivalled(found, frames)

    def _registered(self, match: PlaceMatch, number: int) -> tuple[LoopClosure | None, float]:
        old, new = (self._submaps[n].points.astype(np.float64) for n in (match.number, number))
        points = new[voxel_downsample(new, SPACING)]
        fine = registered(old, points, match.place_T_query, "follow")
        if fine is None:
            return None, 0.0
        overlap = Structure.of(old).shared(Structure.of(new), fine.map_T_scan)
        open_by_surfaces = fine.observed.open(_OPEN**2)  # known by the images
        covariance = fine.covariance + np.diag(DISTORTION) + open_by_surfaces
        return LoopClosure(match.number, number, fine.map_T_scan, covariance), overlap

    def _unrivalled(self, found: list[_Proved], frames: FloatArray) -> list[_Proved]:
        """The loops that agree with the best one; none if another one is nearly as good and says otherwise."""
        if not found:
            return []
        trusted = [one for one in found if one.drift < 1]
        found = sorted(trusted or found, key=lambda one: -one.overlap)
        first = found[0].loop.first
        travelled = np.array(
            [abs(self._submaps[one.loop.first].travelled[1] - self._submaps[first].travelled[1]) for one in found]
        )
        places = np.array([(frames[one.loop.first] @ one.loop.first_T_second)[:3, 3] for one in found])
        overlap = np.array([one.overlap for one in found])
        return [found[k] for k in agreeing(places, overlap, SAME + self.settings.drift * travelled)]

    @staticmethod
    def _farthest(travelled: FloatArray) -> FloatArray:
        return _FARTHEST[0] + _FARTHEST[1] * travelled


_LOG = logging.getLogger(__name__)


class Submaps:
    """The submaps of a drive: the running one, whose points are collected, those closed, and the loops between them.

    spacing: of the points that are kept, m; search: for loops, None for none
    """

    def __init__(self, spacing: float, search: LoopSearch | None) -> None:
        self.closed, self.loops = list[Submap](), list[LoopClosure]()  # loops are between keyframes
        self._spacing, self._search = spacing, search
        self._clouds: list[npt.NDArray[np.float32]] = []  # of the running submap's keyframes
        self._travelled, self._begin = 0.0, 0.0  # m, now and when the running submap began
        self._anchor_T_submap = np.eye(4)  # its frame

    def add(self, points: FloatArray, world_T_sensor: FloatArray, driven: float) -> None:
        """Add the points (N, 3) of the next keyframe; driven: m since the last."""
        self._travelled += driven
        if not self._clouds:
            self._anchor_T_submap, self._begin = upright(world_T_sensor), self._travelled
        self._clouds.append(points[voxel_downsample(points, self._spacing)].astype(np.float32))

    def close(self, graph: SubmapGraph, poses: FloatArray) -> Submap | None:
        """Close the running submap, poses (n, 4, 4) of all keyframes up to its last; None if nothing runs."""
        if not self._clouds:
            return None
        anchor = len(poses) - len(self._clouds)
        inner = inverse_transform(poses[anchor]) @ poses[anchor:]
        points = placed_clouds(self._clouds, inverse_transform(self._anchor_T_submap) @ inner, self._spacing)
        travelled = (self._begin, self._travelled)
        submap = Submap((anchor, len(poses)), self._anchor_T_submap, points.astype(np.float32), travelled)
        self.closed.append(submap)
        self._clouds = []
        if self._search is not None:
            frames = np.array([one.frame(poses) for one in self.closed])
            found = [self._between_anchors(loop) for loop in self._search.add(submap, frames)]
            graph.close_loops(found)
            anchors = [one.keyframes[0] for one in self.closed]
            self.loops += [replace(one, first=anchors[one.first], second=anchors[one.second]) for one in found]
        return submap

    def judged(self, selection: LoopSelection) -> tuple[list[LoopClosure], list[LoopClosure]]:
        """The loops between keyframes that are true, and those that are false, which a warning counts."""
        kept = selection.kept
        true, false = ([self.loops[row] for row in np.flatnonzero(rows).tolist()] for rows in (kept, ~kept))
        if false:
            _LOG.warning("%d of %d loops contradict the other %d, and are left out", len(false), len(kept), len(true))
        return true, false

    def _between_anchors(self, loop: LoopClosure) -> LoopClosure:
        """A loop between frames of submaps as one between their anchors."""
        first, second = (self.closed[n].anchor_T_submap for n in (loop.first, loop.second))
        covariance = carried_covariance(second, loop.covariance) + LEAST
        moved = first @ loop.first_T_second @ inverse_transform(second)
        return replace(loop, first_T_second=moved, covariance=covariance)
