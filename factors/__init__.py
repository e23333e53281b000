"""GTSAM factors of saga-fg: plain arrays, keys and callables in; gtsam and numpy only."""
