"""Values that go through the pipeline: boxes, frames of detections, sensors, road maps, tracks, datasets."""
