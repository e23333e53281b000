"""Values that go through the pipeline: boxes, frames of detections, road maps, tracks, datasets."""
