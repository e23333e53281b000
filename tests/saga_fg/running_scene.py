"""Traffic drawn from the model of the running graph, see `pipelines.bench.drawn_traffic`."""

from pipelines.bench.drawn_traffic import Detections, Objects, Vehicle, draw_traffic, providers

traffic = draw_traffic
__all__ = ["Detections", "Objects", "Vehicle", "providers", "traffic"]
