"""SLAM: pipelines from recordings and graph files to trajectories, landmarks and maps."""
