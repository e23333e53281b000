"""Interactions with the road: stop lines, lanes, cones."""
