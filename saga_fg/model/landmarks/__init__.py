"""Kinds of landmarks: points, poles, planes, lines."""
