"""Settings of the trackers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple, Protocol, Self

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model import (
    AccelerationLaw,
    Attached,
    ConeLine,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    Curvilinear,
    EdgeRule,
    Following,
    GreenLight,
    InLane,
    Mixture,
    Motion,
    Neighbours,
    NonlinearMotion,
    RandomWalk,
    RedLight,
    Repulsion,
    require_stable,
    traffic_rules,
)
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.parts import part_kind
from saga_fg.settings import (
    Fraction,
    FractionBelowOne,
    NonNegative,
    NonNegativeOrInf,
    Positive,
    PositiveInt,
    PositiveOrInf,
    Range,
    Settings,
    setting,
    settings_group,
)
from saga_fg.tracking.by_name import EstimatorMaker, require_estimator
from saga_fg.tracking.clock import MAX_JUMP
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types import DEFAULT, Boxes, RoadMap, SignalSettings

Method = Literal["saga", "kf", "centerpoint"]
AssociationName = Literal["hungarian", "greedy", "graph"]


class AssociationProblem(NamedTuple):
    """The tracks and detections of a frame, between which pairs are to be found.

    sensor, time  its name; time of the frame, s
    id, tracks    (n,) of the tracks, and their predicted boxes, world
    row, detections  (m,) of the detections in the frame, and their boxes, world
    """

    sensor: str
    time: float
    id: IntArray
    tracks: Boxes
    row: IntArray
    detections: Boxes


@part_kind("association cost", "saga_fg.costs")
class AssociationCost(Protocol):
    """A cost of pairs of tracks and detections, added to that of their distance; it keeps nothing between frames."""

    def __call__(self, problem: AssociationProblem) -> FloatArray:
        """(n, m) -2 log of the likelihood ratio that they are one object; infinite where they cannot be."""


@dataclass(frozen=True)
class TypicalSize(Settings):
    """Boxes of a class, to tell it from those that a sensor confuses it with."""

    length: Positive = setting(4.5, "geometric mean of the length, m")
    width: Positive = setting(1.9, "geometric mean of the width, m")
    height: Positive = setting(1.7, "geometric mean of the height, m")
    spread: Positive = setting(
        0.15, "standard deviation of the logarithm of each; usual 0.1 to 0.3; higher: sizes say less"
    )


@dataclass(frozen=True)
class ClassSettings(Settings):
    """Motion, initiation, association and deletion of the tracks of one class."""

    motion: ConstantVelocity | ConstantAcceleration | Curvilinear | RandomWalk | CoordinatedTurn | Mixture | Motion = (
        settings_group(
            lambda: ConstantVelocity(acceleration_noise=2.0),
            "motion model of the class; curvilinear for vehicles with measured headings; random_walk for objects that "
            "never move, such as cones",
        )
    )
    initial_speed_deviation: Positive = setting(
        5.0, "standard deviation of the velocity of a new track along its heading, m/s; usual 1 (pedestrians) to 8"
    )
    initial_lateral_speed_deviation: Positive = setting(
        1.0, "standard deviation of the velocity of a new track across its heading, m/s; usual 0.7 to 1.2"
    )
    min_score: Fraction = setting(
        0.0, "discard detections with a lower probability; higher: fewer false tracks, more misses"
    )
    initiation_score: Fraction = setting(
        0.1, "detections with a lower probability initiate no track; usual 0.02 to 0.3; higher: fewer false tracks"
    )
    nms_distance: NonNegative = setting(
        0.5, "non-maximum suppression: discard the weaker of two detections closer than this, m; usual 0.3 to 1.5"
    )
    weak_nms_distance: NonNegative = setting(
        0.0, "discard a detection this close to a much more probable one, m; usual 1 to 4, 0: never"
    )
    gate: FractionBelowOne = setting(
        0.999, "gate probability: share of true pairs inside the chi-square gate; usual 0.99 to 0.9999; higher: wider"
    )
    max_distance: PositiveOrInf = setting(
        4.0, "largest distance between a prediction and its detection, whatever the gate says, m; usual 1.5 to 12"
    )
    max_deviation: PositiveOrInf = setting(
        1.5,
        "keep and report a track without detections while the standard deviation of its position is below this in "
        "every direction, m; usual 1 to 4; higher: hidden objects are reported for longer, at less certain places",
    )
    typical_size: TypicalSize | None = settings_group(
        lambda: None,
        "boxes of the class, where sensors confuse it with others; null: sizes say nothing about the class",
    )
    yaw_drift: NonNegative = setting(
        0.3, "standard deviation of the change of heading in one second, rad; higher: follows detections faster"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            hash(self.motion)
        except TypeError as error:
            raise InputError(f"motion: expected one that has a hash, as a frozen dataclass: {error}") from error


@dataclass(frozen=True)
class AssociationSettings(Settings):
    """Association of detections to tracks, see `saga_fg.tracking.association`; gates are settings of the classes."""

    method: AssociationName = setting(
        "hungarian", "hungarian: least total cost; greedy: cheapest pair first; graph: distances of pairs count too"
    )
    clutter_area: PositiveOrInf = setting(
        math.inf,
        "area over which false detections spread, m^2; usual 3000 to 10000; higher: more doubtful pairs "
        "match; .inf: all in the gate",
    )
    clear_above: Fraction = setting(
        0.95,
        "probability from which an association counts as certain; below, the update is weighted and identities may be "
        "exchanged later; usual 0.8 to 0.99; 0: no association is doubted",
    )
    relink_above: Annotated[float, Range(0, 1, above=True)] = setting(
        0.9,
        "re-link a track that was not detected with a detection that would initiate another one, from this "
        "probability on; usual 0.8 to 0.99; higher: fewer wrong links, more lost identities, 1: never",
    )
    costs: tuple[str | AssociationCost, ...] = setting(
        (), "your own costs of pairs, MODULE:NAME or {kind: MODULE:NAME, ...settings}, added to that of the distance"
    )


@dataclass(frozen=True)
class ExistenceSettings(Settings):
    """Existence probability of a track: when it is confirmed, reported and deleted."""

    neutral_score: Annotated[float, Range(0, 1, above=True, below=True)] = setting(
        0.2, "detection probability that leaves the existence unchanged; higher: weak detections count against"
    )
    report_above: Fraction = setting(
        0.0,
        "report tracks from this existence probability on; usual 0 to confirm_above; a confirmed track is "
        "always reported; higher: tracks are reported later, fewer false ones",
    )
    confirm_above: Fraction = setting(
        0.9,
        "confirm a track at this existence probability: it is reported, and misses no longer delete it, "
        "only time does; usual 0.8 to 0.99; higher: fewer false tracks, more lost ones",
    )
    prior_opportunities: NonNegative = setting(
        0.0, "missed detection opportunities that each new track starts with in its hit ratio; usual 0 to 1"
    )
    hit_ratio_weight: NonNegative = setting(
        0.0, "power of the hit ratio (hits / opportunities) in the score of a track; 0: it does not count"
    )
    delete_below: Fraction = setting(
        0.02, "delete an unconfirmed track below this existence probability; higher: false tracks end sooner"
    )


@dataclass(frozen=True)
class EgoNodeSettings(Settings):
    """The ego vehicle as a node of the scene graph, see `saga_fg.tracking.measurements`."""

    estimated: bool = setting(
        False, "true: estimate the ego pose with the objects, by factor providers; false: use that of the frames"
    )
    label: str = setting("car", "class of the ego vehicle in edge rules")
    length: Positive = setting(4.5, "length of the ego vehicle, m; usual 4 to 20; higher: others follow farther behind")
    deviation: Positive = setting(
        0.02,
        "standard deviation of the ego position about its pose, m; usual 0.01 to 0.1; higher: smoother",
    )


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """All settings of the tracker; with `edges` empty it is the classical filter of independent objects.

    Raises `InputError` for edge rules that make the dynamics, or a step of up to a second, unstable.
    """

    classes: Mapping[str, ClassSettings] = settings_group(
        lambda: {DEFAULT: ClassSettings()}, "settings by class of object; the entry named default serves all others"
    )
    min_hits: PositiveInt = setting(
        1, "report a track from this detection on, before with tentative_score_factor; higher: later, fewer false ones"
    )
    tentative_score_factor: Fraction = setting(
        0.0,
        "factor on the score of tentative tracks, which may be false or a second box of one object; 0: not reported",
    )
    edges: tuple[
        Following | Neighbours | Repulsion | RedLight | GreenLight | InLane | ConeLine | Attached | EdgeRule, ...
    ] = settings_group(traffic_rules, "edge rules of the scene graph: who interacts with whom; []: no interactions")
    edge_prior: Fraction = setting(
        1.0,
        "probability that an edge governs, before it is known how well such edges predicted objects in view; higher: "
        "edges are believed for longer; 1: always",
    )
    explained_noise: NonNegative = setting(
        0.0, "process noise is scaled by exp(-explained_noise K) at the total rate K of interactions, s; usual 0 to 2"
    )
    max_step: PositiveOrInf = setting(
        math.inf, "longest prediction step, s; longer intervals are split, with edges of their own; .inf: never split"
    )
    signals: SignalSettings = settings_group(
        SignalSettings,
        "traffic lights of a map; traffic tells colours by the first red_light and green_light rule only",
    )
    road_map: RoadMap | None = settings_group(
        lambda: None, "lights, stop lines, lanes and walls in world coordinates; null: those that frames bring along"
    )
    estimator: str | EstimatorMaker = setting(
        "kalman",
        "kalman: fastest; isam2: the same filter as a factor graph of the last interval; fixed-lag: a factor graph "
        "of the last `lag` seconds, exact for late frames; MODULE:NAME or the name of an entry point: your own",
    )
    tolerance: FractionBelowOne = setting(
        0.01,
        "correlation up to which the estimator kalman takes objects for independent; usual 0 to 0.1; 0: never; higher: "
        "faster in crowds, interactions of objects in plain view count less",
    )
    max_component: PositiveInt = setting(
        64,
        "largest number of objects whose correlations the estimator kalman keeps together, the strongest; usual 30 to "
        "200; higher: nearer to exact where hundreds interact, slower",
    )
    providers: tuple[str | FactorProvider, ...] = setting(
        (), "factor providers, MODULE:NAME or {kind: MODULE:NAME, ...settings}, of saga_fg.providers or your own"
    )
    ego: EgoNodeSettings | None = settings_group(
        lambda: None, "ego vehicle as a node that leads and follows others; null: not in the graph"
    )
    lag: NonNegative = setting(
        2.0, "window of the fixed-lag estimator, s; usual 0.5 to 5; higher: better states behind the present, slower"
    )
    association: AssociationSettings = settings_group(AssociationSettings, "association of detections to tracks")
    existence: ExistenceSettings = settings_group(ExistenceSettings, "when tracks are confirmed, reported and deleted")
    traffic: TrafficSettings = settings_group(
        TrafficSettings, "memory of where traffic went and how fast, for the paths and speeds of others"
    )
    stationary_share: FractionBelowOne = setting(
        0.0, "share of new objects that are stationary; 0: off; usual 0.5 where many cars are parked; higher: more rest"
    )
    max_jump: PositiveOrInf = setting(
        MAX_JUMP,
        "leave out a frame further than this from the newest until a second confirms its time, s; usual 2 to 30; "
        "higher: longer pauses are no jumps",
    )
    max_delay: NonNegative = setting(
        0.5, "discard frames that are older than the newest by more than this, s; higher: more late frames are used"
    )
    max_coasting: PositiveOrInf = setting(
        6.0,
        "delete a track this long after its last detection, however well its place is known, s; usual 3 to 10; higher: "
        "longer occlusions, more tracks",
    )
    report_coasting: NonNegativeOrInf = setting(
        math.inf,
        "report no track for longer than this after its last detection, s; .inf: for as long as `max_deviation` lets "
        "it; higher: fewer gaps, more false positives",
    )
    report_out_of_view: bool = setting(
        False, "true: report tracks outside every field of view as well, as long as the other limits let them"
    )

    def of_method(self, method: Method) -> Self:
        """Return a copy for a method: without edges, trails and lanes, unless it is `saga`."""
        return self if method == "saga" else replace(self, edges=(), traffic=replace(self.traffic, reach=0.0))

    def nonlinear(self, rules: Sequence[EdgeRule]) -> bool:
        """Return True if a class moves nonlinearly or an edge rule is nonlinear."""
        moving = any(isinstance(one.motion, NonlinearMotion) for one in self.classes.values())
        return moving or any(isinstance(rule.interaction, AccelerationLaw) for rule in rules)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_estimator(self.estimator)
        if self.ego is not None and self.ego.estimated and self.association.method == "graph":
            raise InputError("ego.estimated: expected association without pairs, got association.method graph")
        require_stable(self.edges, self.max_step)
