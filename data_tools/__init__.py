"""Datasets, simulator, LiDAR geometry, metrics, export and plots of saga-fg."""
