"""Settings of the trackers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model.edge_network import EdgeNetwork
from saga_fg.model.edge_rules import EdgeRule, Following, Neighbours, Repulsion
from saga_fg.model.modes import Mixture
from saga_fg.model.node import ConstantAcceleration, ConstantVelocity, NonlinearMotion, RandomWalk
from saga_fg.model.nonlinear_interactions import AccelerationLaw
from saga_fg.model.rigid_coupling import Attached
from saga_fg.model.road.cones import ConeLine
from saga_fg.model.road.lane_keeping import InLane
from saga_fg.model.road.stopping import RedLight
from saga_fg.model.stability import require_stable
from saga_fg.model.turning import Bicycle, CoordinatedTurn
from saga_fg.settings import (
    Fraction,
    NonNegative,
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.tracking.names import AssociationName, EstimatorName
from saga_fg.types.by_class import DEFAULT, class_settings
from saga_fg.types.road_map import RoadMap
from saga_fg.types.signal import SignalSettings


@dataclass(frozen=True)
class ClassSettings(Settings):
    """How objects of one class move, are born, matched and given up."""

    motion: ConstantVelocity | ConstantAcceleration | RandomWalk | CoordinatedTurn | Bicycle | Mixture = settings_group(
        lambda: ConstantVelocity(acceleration_noise=2.0), "own motion; random_walk for what stands, such as cones"
    )
    initial_speed_deviation: Positive = setting(
        5.0, "standard deviation of an unmeasured velocity at birth, along the heading, m/s"
    )
    initial_lateral_speed_deviation: Positive = setting(
        1.0, "standard deviation of an unmeasured velocity at birth, across the heading, m/s"
    )
    min_score: Fraction = setting(0.0, "detections with a lower probability are not used at all")
    initiation_score: Fraction = setting(0.1, "detections with a lower probability start no track")
    nms_distance: NonNegative = setting(0.5, "of two detections of the class closer than this the weaker goes, m")
    weak_nms_distance: NonNegative = setting(
        0.0, "a detection this close to a much stronger one of the class is its shadow, m"
    )
    weak_nms_ratio: Fraction = setting(0.5, "much stronger: the weaker has less than this share of its probability")
    merge_distance: NonNegative = setting(
        0.0, "a track that is not seen ends this close to one of the class that is, m"
    )
    cross_class_nms_iou: Fraction = setting(
        1.0, "a detection whose IoU, from above, with a more probable one of another class is larger goes; 1: never"
    )
    giou_weight: NonNegative = setting(
        0.0, "what a whole unit of 3D GIoU counts in matching, as a squared distance in sigmas"
    )
    gate: Fraction = setting(0.999, "share of true pairs that the chi-square gate lets through")
    max_distance: PositiveOrInf = setting(4.0, "no match beyond this distance between prediction and detection, m")
    max_coasting: PositiveOrInf = setting(1.2, "a track without detection is given up after this time, s")
    yaw_drift: NonNegative = setting(0.3, "how fast the heading changes, standard deviation after one second, rad")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gate == 1:
            raise InputError("gate: expected a share below 1, since a gate of 1 lets everything through")


@dataclass(frozen=True)
class AssociationSettings(Settings):
    """How detections are matched to tracks, see `saga_fg.tracking.association`; gates and caps are the classes'."""

    method: AssociationName = setting(
        "hungarian", "least total cost, the cheapest pair first, or graph: what pairs say of each other counts too"
    )
    pair_weight: NonNegative = setting(1.0, "how much that counts, 1 by its face value, 0 not; used with method: graph")
    clutter_area: PositiveOrInf = setting(
        math.inf, "what is false in a frame is spread over this area, m^2; .inf: any pair inside the gate is a match"
    )
    existence_weight: NonNegative = setting(0.3, "how much the existence of a track counts, 1 by its face value, 0 not")
    score_weight: NonNegative = setting(
        0.5, "how much the probability of a detection counts, 1 by its face value, 0 not"
    )


@dataclass(frozen=True)
class ExistenceSettings(Settings):
    """The probability that a track is a real object."""

    lifetime: PositiveOrInf = setting(30.0, "mean time after which an object leaves unseen, s")
    clutter_score: Fraction = setting(0.2, "probability score at which a matched detection neither helps nor hurts")
    report: Fraction = setting(0.0, "tracks are reported from this existence probability on")
    confirm: Fraction = setting(0.9, "from here on a track is confirmed: misses no longer end it, only time does")
    newness: NonNegative = setting(0.0, "looks in vain a new track starts with in the share of looks that saw it")
    steadiness_weight: NonNegative = setting(
        0.0, "power of that share that a track's score is multiplied by, 0 for none"
    )
    coasting_score: Fraction = setting(1.0, "what a track's score is worth without a detection, besides its existence")
    occlusion: Fraction = setting(
        0.0, "share of the chance of a detection that a track wholly hidden behind another loses; 0: hidden is as seen"
    )
    give_up: Fraction = setting(0.02, "unconfirmed tracks below this existence probability are removed")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clutter_score in (0, 1):
            raise InputError(f"clutter_score: expected a probability inside 0 to 1, got {self.clutter_score!r}")


@dataclass(frozen=True)
class FlowSettings(Settings):
    """What a new track takes over from traffic that heads the same way, see `saga_fg.tracking.traffic_flow`."""

    weight: NonNegative = setting(
        0.0, "what a neighbour counts for the speed of a new track against knowing nothing; 0: off"
    )
    ahead_scale: PositiveOrInf = setting(15.0, "sigma of the kernel on the distance along the heading, m")
    lateral_scale: PositiveOrInf = setting(2.0, "sigma of the kernel on the distance across the heading, m")
    heading_scale: PositiveOrInf = setting(0.3, "sigma of the kernel on the difference of headings, rad")
    spread: NonNegative = setting(2.0, "standard deviation of the difference between the speeds of neighbours, m/s")
    known_speed: PositiveOrInf = setting(1.5, "tracks whose speed is less certain than this teach nothing, m/s")
    memory: NonNegative = setting(5.0, "where tracks passed is remembered for this long, s")


@dataclass(frozen=True)
class StandingSettings(Settings):
    """The belief that an object stands still, see `saga_fg.tracking.stationarity`."""

    prior: Fraction = setting(0.0, "share of new objects that stand; 0: standing is no case of its own")
    depart: NonNegative = setting(0.02, "rate at which what stands starts to move, 1/s")
    halt: NonNegative = setting(0.05, "rate at which what moves comes to stand, 1/s")
    drift: NonNegative = setting(
        0.02, "how far the place of what stands drifts, standard deviation after one second, m"
    )
    noise: Fraction = setting(0.05, "share of the process noise that is left to what stands")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prior == 1 or self.noise == 0:
            raise InputError("prior and noise: expected a prior below 1 and some noise, since everything may move")


@dataclass(frozen=True)
class ClockSettings(Settings):
    """Which timestamps are believed, see `saga_fg.tracking.clock`."""

    max_jump: PositiveOrInf = setting(
        10.0, "a frame further than this from the newest time is left out until a second one confirms its time, s"
    )
    late_run: PositiveInt = setting(
        3, "new frames in a row by which a sensor goes back in time, after which the clock is set back"
    )


@dataclass(frozen=True)
class EgoNodeSettings(Settings):
    """The vehicle as a node of the scene graph, see `saga_fg.tracking.ego_node`."""

    estimated: bool = setting(
        False,
        "its pose is a variable of the running graph, which providers move, and detections in its frame are seen from "
        "there; false: it is where frames say",
    )
    label: str = setting("car", "its class for edge rules")
    length: Positive = setting(4.5, "m")
    deviation: Positive = setting(0.02, "standard deviation of its place about its pose, m")


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """Everything the tracker can be told; `edges` empty is the classical filter of independent objects.

    Raises `InputError` for edge rules that make the dynamics, or a step of up to a second, unstable.
    """

    classes: Mapping[str, ClassSettings] = field(
        default_factory=lambda: {DEFAULT: ClassSettings()},
        metadata={"comment": "by class; the entry named default serves all others"},
    )
    edges: tuple[Following | Neighbours | Repulsion | EdgeNetwork | RedLight | InLane | ConeLine | Attached, ...] = (
        settings_group(lambda: (Following(), Neighbours()), "edge rules of the scene graph; [] for independent objects")
    )
    class_groups: tuple[tuple[str, ...], ...] = setting(
        (),
        "groups of classes that detectors mistake for each other: tracks believe in all of a group, and a detection of "
        "one may be of a track of another; []: a track has the class it was born with",
    )
    explained_noise: NonNegative = setting(
        0.0, "a node acted on at the total rate K moves with exp(-explained_noise K) of its own noise, s"
    )
    max_step: PositiveOrInf = setting(
        math.inf,
        "a longer interval is predicted in several steps, at most 100, each with edges of its own, s; .inf: in one",
    )
    signals: SignalSettings = settings_group(SignalSettings, "traffic lights, where a map knows of any")
    road_map: RoadMap | None = settings_group(
        lambda: None, "lights, stop lines and lanes, world coordinates; null: none but those that frames bring along"
    )
    estimator: EstimatorName = setting("kalman", "what holds the joint state of the tracks")
    providers: tuple[str | FactorProvider, ...] = setting(
        (),
        "factor providers as MODULE:NAME, or with settings as {kind: MODULE:NAME, ...}, of saga_fg.providers or your "
        "own; the modules are imported",
    )
    ego: EgoNodeSettings | None = settings_group(
        lambda: None, "the vehicle as a node that leads and follows; null: it is none"
    )
    lag: NonNegative = setting(
        2.0, "window of the fixed-lag estimator, s; without providers, frames this late are put where they belong"
    )
    association: AssociationSettings = settings_group(AssociationSettings, "how detections are matched to tracks")
    existence: ExistenceSettings = settings_group(ExistenceSettings, "when a track is believed")
    flow: FlowSettings = settings_group(FlowSettings, "the speed of new tracks from traffic around them")
    standing: StandingSettings = settings_group(StandingSettings, "whether an object stands or moves")
    report_speed_known: PositiveOrInf = setting(
        math.inf,
        "a track is first reported when the standard deviation of its velocity is below this, m/s; .inf: at once",
    )
    score_memory: NonNegative = setting(0.15, "what a sensor said of a track counts for its score for this long, s")
    confirmations: PositiveInt = setting(
        3, "detections that confirm a track born of a weak sensor; another sensor's one does"
    )
    unconfirmed_share: Fraction = setting(
        0.0, "share of its score with which a track is reported that waits for confirmation; 0: not at all"
    )
    clock: ClockSettings = settings_group(ClockSettings, "which timestamps are believed")
    max_delay: NonNegative = setting(0.5, "a frame that comes later than this is left out, s")
    max_out_of_view: PositiveOrInf = setting(
        0.5, "a track outside every sensor's field of view is given up after this time, s"
    )
    report_coasting: NonNegative = setting(0.6, "tracks are reported for this long after their last detection, s")

    def nonlinear(self, rules: Sequence[EdgeRule]) -> bool:
        """Whether any class moves nonlinearly, or any of the edge rules acts so."""
        moving = any(isinstance(one.motion, NonlinearMotion) for one in self.classes.values())
        return moving or any(isinstance(rule.interaction, AccelerationLaw) for rule in rules)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ego is not None and self.ego.estimated:
            if self.association.method == "graph":
                raise InputError("ego.estimated: expected association without pairs, got association.method graph")
            if self.estimator == "kalman":
                raise InputError("ego.estimated: expected the estimator isam2 or fixed-lag, got kalman")
        self._require_groups_that_move_alike()
        require_stable(self.edges, self.max_step)

    def _require_groups_that_move_alike(self) -> None:
        grouped = [label for group in self.class_groups for label in group]
        if len(set(grouped)) < len(grouped) or not all(len(group) > 1 for group in self.class_groups):
            raise InputError(f"class_groups: expected groups of two classes and more, none in two, got {grouped}")
        for group in self.class_groups:
            motions = {class_settings(self.classes, ClassSettings, label).motion for label in group}
            kinds = {type(motion).__name__ for motion in motions}
            if len(kinds) > 1 or (len(motions) > 1 and kinds == {Mixture.__name__}):
                raise InputError(
                    f"class_groups: expected one kind of motion in {', '.join(group)}, or one mixture, "
                    f"got {sorted(kinds)}"
                )


@dataclass(frozen=True)
class GreedySettings(Settings):
    """The greedy nearest-centre tracker (Yin et al., CenterPoint, CVPR 2021, section 4.2)."""

    max_distance: Mapping[str, float] = field(
        default_factory=lambda: {DEFAULT: 4.0, "pedestrian": 1.0, "bicycle": 3.0, "motorcycle": 13.0},
        metadata={"comment": "largest distance between prediction and detection by class, m"},
    )
    max_coasting: PositiveOrInf = setting(1.2, "a track without detection is kept this long, s")
    baseline: NonNegative = setting(0.2, "velocities are differences of positions at least this far apart in time, s")
    min_score: Fraction = setting(0.0, "detections with a lower probability are not used")
    clock: ClockSettings = settings_group(ClockSettings, "which timestamps are believed")
    max_delay: NonNegative = setting(0.5, "a frame that comes later than this is left out, s")
