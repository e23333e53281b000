"""Poses of the vehicle in the graph: with objects, with landmarks, and pose graphs."""
