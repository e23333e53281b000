"""The benchmark of gaps: objects that nobody sees for some seconds, through the whole tracker on detections."""
