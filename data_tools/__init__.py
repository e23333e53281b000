"""Datasets, simulator, LiDAR geometry, metrics and plots of saga-fg."""
