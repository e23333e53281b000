"""Dense road traffic, seen by a sensor that stands or hovers: its settings.

Drones and roadside sensors give vehicles with headings, many at a time and often. There a vehicle keeps to its course,
to the trails of those before it, and does what its leader does (`saga_fg.tracking.traffic`). The motion of vehicles was
chosen on half of the windows of two recorded roads, and confirmed on the others.
"""

from functools import cache

from saga_fg.model import ConstantVelocity, Curvilinear, Following, GreenLight, RedLight, SharedVelocity, Stopping
from saga_fg.tracking.settings import AssociationSettings, ClassSettings, TrackerSettings
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types import DEFAULT, SignalSettings


@cache
def dense_traffic_settings() -> TrackerSettings:
    """Settings of the tracker for dense road traffic, of which nothing else is known."""
    return TrackerSettings(
        classes={
            DEFAULT: ClassSettings(
                motion=Curvilinear(jerk_noise=0.3, fading_time=4.0, course_time=0.2),
                initial_speed_deviation=8.0,
                gate=0.99999,
                initiation_score=0.3,
                nms_distance=1.0,
                max_distance=8.0,
                max_deviation=3.0,
            ),
            "pedestrian": ClassSettings(
                motion=ConstantVelocity(acceleration_noise=0.3),
                initial_speed_deviation=1.2,
                initial_lateral_speed_deviation=1.2,
                gate=0.99999,
                initiation_score=0.3,
                nms_distance=0.3,
                max_distance=2.0,
                max_deviation=1.5,
            ),
        },
        min_hits=2,
        traffic=TrafficSettings(memory=60.0),
        edges=(
            RedLight(interaction=Stopping(margin=0.5), reaction_deceleration=0.8, full_deceleration=1.8),
            GreenLight(),
            Following(  # parked: all are on the road, and who was never seen moving waits in a queue
                interaction=SharedVelocity(along_heading=True),
                rate=1.5,
                max_gap=60.0,
                gap_scale=16.0,
                lateral_scale=0.8,
                parked=True,
            ),
        ),
        edge_prior=0.95,  # edges answer for themselves: a leader who has crossed the line no longer leads
        signals=SignalSettings(red_duration=70.0, amber_duration=3.5, green_duration=25.0, driver_noise=1.0),
        association=AssociationSettings(clutter_area=5000.0),
    )
