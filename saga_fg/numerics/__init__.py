"""Arrays, geometry, assignment: the numerics that know nothing of tracking."""
