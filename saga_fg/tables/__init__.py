"""Tables of detections, of files and programs: what their columns mean, whether that is plausible, and their frames."""
